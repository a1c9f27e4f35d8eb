"""Gaussians and camera poses that grow together, photo by photo, from photometric alignment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import torch
from poses import Poses, exponential
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat import ops
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import compose_rigid, invert_rigid, transform_points
from snowsplat.scene.render import render
from snowsplat.scene.sh_constants import SH_C0

#: Learning rates of the Gaussians in units of a mean depth of 1, and of the poses.
RATES = {
    "means": 4e-4,
    "log_scales": 1e-2,
    "quats": 2e-3,
    "opacity_logits": 3e-2,
    "sh_dc": 8e-3,
}
POSE_RATE = 4e-3
#: Rotations around the optical axis with which tracking starts, in radians.
ROLLS = (0.0, -0.2, 0.2)


def reduced(photo: Tensor, factor: int) -> Tensor:
    """(h, w, 3): the photo (H, W, 3) reduced by a factor, as `Camera.downscaled` expects it."""
    if factor == 1:
        return photo
    size = (max(1, photo.shape[0] // factor), max(1, photo.shape[1] // factor))
    planes = interpolate(photo.permute(2, 0, 1)[None], size, mode="area")[0]
    return planes.permute(1, 2, 0).contiguous()


def image_loss(image: Tensor, photo: Tensor) -> Tensor:
    """0.8 L1 + 0.2 D-SSIM."""
    return ops.photometric_loss(image, photo, 0.2)


def photo_gaussians(
    photo: Tensor, camera: Camera, inverse_depth: Tensor, chosen: Tensor | None = None
) -> Gaussians:
    """A Gaussian for each (chosen) pixel (H, W): on its ray, as wide as a pixel.

    Differentiable with respect to ``inverse_depth`` (H, W).
    """
    height, width = inverse_depth.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = 1.0 / inverse_depth
    cam = torch.stack(
        [
            (x + 0.5 - camera.cx) / camera.fx * depth,
            (y + 0.5 - camera.cy) / camera.fy * depth,
            depth,
        ],
        dim=2,
    ).reshape(-1, 3)
    means = transform_points(invert_rigid(camera.cam_from_world).to(torch.float32), cam)
    log_scales = (0.6 * depth / camera.fx).log().reshape(-1, 1).expand(-1, 3)
    colors = (photo.reshape(-1, 3) - 0.5) / SH_C0
    if chosen is not None:
        rows = chosen.reshape(-1).nonzero()[:, 0]
        means, log_scales, colors = means[rows], log_scales[rows], colors[rows]
    n = len(means)
    return Gaussians(
        means=means,
        log_scales=log_scales.contiguous(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.full((n,), math.log(0.8 / 0.2)),
        sh_dc=colors[:, None].contiguous(),
        sh_rest=torch.zeros(n, 0, 3),
    )


def first_depths(photos: list[Tensor], poses: Poses, levels: list[tuple[int, int, int]]) -> Tensor:
    """The inverse depths (H, W) of photo 0, together with the poses of the other photos.

    Everything starts at depth 1 and with equal poses. The inverse depths are those of a coarse
    grid, interpolated bilinearly, which becomes finer from level to level, and so do the photos.

    Args:
        levels: for each level, the factor by which photos are reduced, the number of cells along
            the longer side of the grid, and the number of steps.
    """
    height, width = photos[0].shape[:2]
    grid = torch.zeros(1, 1, 2, 2)
    for factor, cells, steps in levels:
        scale = cells / max(width, height)
        size = (max(2, round(scale * height)), max(2, round(scale * width)))
        grid = interpolate(grid, size, mode="bilinear", align_corners=True).requires_grad_()
        optimizer = torch.optim.Adam(
            [{"params": [grid], "lr": 0.02}, {"params": [poses.motion], "lr": POSE_RATE}]
        )
        camera = replace(poses.camera_of(0, factor), cam_from_world=poses.base[0])
        small = [reduced(photo, factor) for photo in photos]
        for step in range(steps):
            log_inverse = interpolate(
                grid, (camera.height, camera.width), mode="bilinear", align_corners=True
            )[0, 0]
            gaussians = photo_gaussians(small[0], camera, log_inverse.exp())
            i = 1 + step % (len(photos) - 1)
            output = render(gaussians, poses.camera_of(i, factor))
            covered = (output.alpha > 0.9).detach()[..., None]
            target = torch.where(covered, small[i], output.image.detach())
            smooth = (grid[..., 1:, :] - grid[..., :-1, :]).abs().mean() + (
                grid[..., 1:] - grid[..., :-1]
            ).abs().mean()
            loss = image_loss(output.image, target) + 0.01 * smooth
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            with torch.no_grad():
                poses.motion[0] = 0.0  # the world frame
        poses.fold()
        with torch.no_grad():  # the unit of length: a mean inverse depth of 1
            mean = float(grid.exp().mean())
            grid = grid.detach() - math.log(mean)
            poses.scale(mean)
    final = interpolate(grid, (height, width), mode="bilinear", align_corners=True)[0, 0]
    return final.exp()


@dataclass
class GrowingMap:
    """Gaussians of the photos so far; ``poses`` are valid up to the last photo that was added."""

    poses: Poses
    photos: list[Tensor]
    gaussians: Gaussians

    def track(self, i: int, levels: list[tuple[int, int]]) -> float:
        """Estimate the pose of photo i with constant Gaussians; returns the loss.

        The first level starts from several motions: that of the photo before times 0, 1 and 2, each
        also with a rotation around the optical axis, because cameras in a hand roll.

        Args:
            levels: the factor by which the photo is reduced, and the number of steps.
        """
        base = self.poses.base
        step = compose_rigid(base[i - 1], invert_rigid(base[i - 2]))
        still = base[i - 1].clone()
        moved = compose_rigid(step, still)
        rolls = [exponential(torch.tensor([0.0, 0.0, r, 0.0, 0.0, 0.0]).double()) for r in ROLLS]
        found = []
        for start, roll in product((still, moved, compose_rigid(step, moved)), rolls):
            base[i] = compose_rigid(roll, start)
            found.append((self.align(i, *levels[0]), base[i].clone()))
        base[i] = min(found, key=lambda each: each[0])[1]
        return [self.align(i, *level) for level in levels[1:]][-1]

    def align(self, i: int, factor: int, steps: int) -> float:
        """Optimise the pose of photo i, reduced by a factor, with constant Gaussians."""
        frozen = self.gaussians.detach()
        optimizer = torch.optim.Adam([self.poses.motion])
        target = reduced(self.photos[i], factor)
        for step in range(steps):
            rate = 0.5 * POSE_RATE * factor * 0.1 ** (step / steps)
            optimizer.param_groups[0]["lr"] = rate
            output = render(frozen, self.poses.camera_of(i, factor))
            covered = (output.alpha > 0.9).detach()[..., None]
            loss = image_loss(output.image, torch.where(covered, target, output.image.detach()))
            loss = loss / covered.float().mean().clamp(min=0.1)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        self.poses.fold()
        return float(loss.detach())

    @torch.no_grad()
    def extend(self, i: int) -> int:
        """Add Gaussians for the pixels of photo i that nothing covers; returns their number."""
        camera = self.poses.camera_of(i, 1)
        output = render(self.gaussians, camera, with_depth=True)
        assert output.depth is not None
        covered = output.alpha > 0.7
        depth = torch.where(covered, output.depth / output.alpha.clamp(min=1e-6), torch.nan)
        inverse = filled(1.0 / depth)
        new = photo_gaussians(self.photos[i], camera, inverse, ~covered)
        self.gaussians = self.gaussians.append(new)
        return len(new)

    def refine(self, chosen: list[int], steps: int, generator: torch.Generator) -> None:
        """Optimise all Gaussians and the poses of the chosen photos, except that of photo 0."""
        parameters = {
            name: tensor.detach().clone().requires_grad_()
            for name, tensor in self.gaussians.parameters().items()
            if tensor.numel()
        }
        groups = [{"params": [tensor], "lr": RATES[name]} for name, tensor in parameters.items()]
        groups.append({"params": [self.poses.motion], "lr": 0.2 * POSE_RATE})
        optimizer = torch.optim.Adam(groups, eps=1e-15)
        rest = self.gaussians.sh_rest
        for _ in range(steps):
            i = chosen[int(torch.randint(len(chosen), (), generator=generator))]
            gaussians = Gaussians(**parameters, sh_rest=rest)
            image = render(gaussians, self.poses.camera_of(i, 1)).image
            loss = image_loss(image, self.photos[i])
            optimizer.zero_grad()
            loss.backward()
            if self.poses.motion.grad is not None:
                self.poses.motion.grad[0] = 0.0
            optimizer.step()
        self.poses.fold()
        self.gaussians = Gaussians(**{n: t.detach() for n, t in parameters.items()}, sh_rest=rest)
        keep = self.gaussians.opacities > 0.05
        self.gaussians = self.gaussians.select(keep)


def filled(image: Tensor) -> Tensor:
    """(H, W): NaN replaced by the mean of the nearest known pixels, from coarse to fine."""
    known = ~image.isnan()
    if not known.any():
        return torch.ones_like(image)
    weight = known.to(image.dtype)[None, None]
    value = image.nan_to_num(0.0)[None, None] * weight
    result = image.clone()
    size = image.shape
    while result.isnan().any():
        small = (max(1, value.shape[2] // 2), max(1, value.shape[3] // 2))
        value = interpolate(value, small, mode="area")
        weight = interpolate(weight, small, mode="area")
        mean = torch.where(weight > 0, value / weight, torch.nan)
        large = interpolate(mean, size, mode="nearest")[0, 0]
        result = torch.where(result.isnan(), large, result)
    return result
