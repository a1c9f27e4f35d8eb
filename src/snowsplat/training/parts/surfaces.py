"""`Surfaces`: flat Gaussians that lie in the surface that they show.

Photos alone are reproduced as well by a cloud of round Gaussians around a surface. Two terms make
surfaces of it, from Huang et al. 2024 (2DGS, arXiv:2403.17888) and Chen et al. 2024 (PGSR,
arXiv:2406.06521):

- Flat. The smallest scale of a Gaussian shrinks by a steady rate, down to a share of the middle
  one, like the scales of `Decay`: Adam restores it where the photos need thickness.
- Consistent. The normal n of a Gaussian is the axis of its smallest scale, towards the camera, and
  its plane has the distance δ = n · μ from the camera. Both are rendered: N = Σ T α n and
  Δ = Σ T α δ. Along the ray r with z = 1, the plane of a pixel has the depth Δ / (N · r), which
  does not depend on where in its plane the centre of a Gaussian is (PGSR, eq. 5). The normal N_d of
  this depth map should be the rendered one. The loss is the mean of w (alpha − N · N_d). The weight
  w is the cosine between N_d and the ray: the edges of the depth map look like steep surfaces.

The second term begins when most of the Gaussians are there. Its gradient reaches them through their
splats as that of the photos does, and directly through n and δ. N and Δ are a rendering of their
own, which takes longer than a step without it. So only one step of `_EVERY` has it, with as many
times the weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.splats import COLORS, Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.scene.surface_normals import interior_pixels, normals_of_depth, rays_of
from snowsplat.training.parts.part import Part
from snowsplat.training.step.batch import Batch, Gradients, rounds

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: The weight of the consistency, the share of the steps after which it begins, and the number of
#: steps of which one has it.
_WEIGHT, _FROM, _EVERY = 0.1, 0.4, 4
#: Number of steps between two reductions of the smallest scale, the factor of each, and the ratio
#: to the middle scale below which there is none.
_INTERVAL, _SHRINK, _FLAT = 10, 0.97, 0.1
#: The least cosine between the rendered normal and the ray of a pixel that has a depth.
_SIDEWAYS = 0.05


class Surfaces(Part):
    """Flattens the Gaussians, and makes depths and normals consistent. It has no state."""

    name = "surfaces"

    def between(self, run: Run) -> None:
        """Flatten in place, in every `_INTERVAL`-th step."""
        times = run.schedule.multiples(run.step, _INTERVAL)
        if times:
            scales = run.gaussians.log_scales
            smallest, middle, _ = scales.sort(dim=1).values.unbind(1)
            flat = torch.minimum(smallest, middle + math.log(_FLAT))
            flatter = torch.maximum(smallest + times * math.log(_SHRINK), flat)
            scales.scatter_(1, scales.argmin(1, keepdim=True), flatter[:, None])

    def gradients(self, run: Run, step: int, batch: Batch, gradients: Gradients) -> None:
        """Add those of the consistency, in one step of `_EVERY`; see the module."""
        times = run.schedule.multiples(step, _EVERY)
        if step <= run.schedule.step_of(_FROM) or not times:
            return
        # The gradient is that of the mean of the batch, of whose steps `times` have the term.
        weight = _WEIGHT / len(batch) * (_EVERY * times / len(batch))
        means = run.gaussians.means.detach().requires_grad_()
        quats = run.gaussians.quats.detach().requires_grad_()
        axis = run.gaussians.log_scales.argmin(1)
        views = zip(batch, gradients, strict=True)
        for group in rounds(list(views), run.shards.size):
            planes, drawn = [], []
            for view, gradient in group:
                assert gradient.splats.ids is not None
                # On a GPU, empty rows have the id -1.
                rows = gradient.splats.ids.clamp(min=0).long()
                with torch.enable_grad():
                    planes.append(planes_of(means[rows], quats[rows], axis[rows], view.camera))
                drawn.append(with_planes(gradient.splats, planes[-1].detach()))
            blended = run.shards.exchange(drawn)
            if blended is not None:
                blended.packed.requires_grad_()
                camera = group[run.shards.rank][0].camera
                with torch.enable_grad():
                    loss = weight * consistency(blended, camera, run.runner.capacity)
                loss.backward()
            run.shards.return_gradients(blended, drawn, absolute=False)
            for (_, gradient), of_view, splats in zip(group, planes, drawn, strict=True):
                found = splats.packed.grad
                assert found is not None
                gradient.packed_grad[:, :COLORS] += found[:, :COLORS]
                of_view.backward(found[:, COLORS : COLORS + splats.channels])
        for parameter, leaf in ((run.gaussians.means, means), (run.gaussians.quats, quats)):
            assert leaf.grad is not None
            parameter.grad = leaf.grad if parameter.grad is None else parameter.grad + leaf.grad


def planes_of(means: Tensor, quats: Tensor, axis: Tensor, camera: Camera) -> Tensor:
    """(M, 4): the normals in the camera frame, towards the camera, and n · μ, at most 0.

    Args:
        means: (M, 3) in the world frame.
        quats: (M, 4).
        axis: (M,) int64, that of the smallest scale.
    """
    index = axis[:, None, None].expand(-1, 3, 1)
    normals = rotation_from_quat(quats).gather(2, index)[..., 0].unbind(1)
    # Products of matrices are rounded by another rule for each M, and each process has some rows.
    turn, offset = camera.cam_from_world.to(means).split([3, 1], dim=1)
    turned = [_dot(row.unbind(), normals) for row in turn]
    distances = _dot(normals, means.unbind(1)) + _dot(turned, offset.unbind())
    sign = torch.where(distances > 0, -1.0, 1.0)
    return torch.stack([*turned, distances], dim=1) * sign[:, None]


def _dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def with_planes(splats: Splats2D, planes: Tensor) -> Splats2D:
    """The same splats with their planes (M, 4) in place of colours; without gradient."""
    packed = splats.packed.detach().clone()
    channels = planes.shape[1]
    packed[:, COLORS : COLORS + channels] = planes
    return Splats2D(packed, splats.ids, channels)


def consistency(splats: Splats2D, camera: Camera, capacity: Capacity | None = None) -> Tensor:
    """The mean () of w (alpha − N · N_d), differentiable in ``splats.packed``.

    Args:
        splats: M splats whose 4 channels are their planes, see `planes_of`.
        camera: of the splats.
        capacity: see `ops.rasterize`.
    """
    image, alpha, _ = ops.rasterize(splats, camera.width, camera.height, capacity=capacity)
    normals, distances = image.permute(2, 0, 1).split([3, 1])
    rays = rays_of(camera, splats.packed)
    along, lengths = (normals * rays).sum(0), rays.square().sum(0).sqrt()
    # The planes face the camera, so `along` is negative. Those seen from the side have no depth.
    shown = (along < -_SIDEWAYS * lengths) & (distances[0] < 0)
    depth = torch.where(shown, distances[0], -1.0) / torch.where(shown, along, -1.0)
    from_depth = normals_of_depth(depth, camera)
    with torch.no_grad():
        # All nine pixels around have a depth. At the border of the image, the normals are 0.
        weight = interior_pixels(shown) * -((from_depth * rays).sum(0) / lengths).clamp(max=0.0)
    return (weight * (alpha.detach() - (normals * from_depth).sum(0))).mean()
