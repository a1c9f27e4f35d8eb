"""A picture of Gaussians for a screen: `draw`."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.splats import COLORS, CONICS, OPACITIES, Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.util.process import single_threaded
from snowsplat.viewer.live import palette
from snowsplat.viewer.live.look import Look, Placed

# Standard deviation of the dot of a point, pixels.
_DOT = 0.8
# Ellipsoids end at so many standard deviations; what is fainter than this has none.
_ELLIPSOID_END, _ELLIPSOID_OPACITY = 1.5, 0.1
# exp(this) is the opacity that makes a Gaussian a disc: α stays at its highest as far as
# ½ d² = this, and is gone at ½ d² = this + 5.5, that is within 3% of the radius.
_DISC = 80.0
# This mean absolute difference of the colours, and this many Gaussians, have the palette's end.
_WORST, _MANY = 0.25, 256.0
# What shows mostly background has neither depth nor normal.
_OPAQUE_ENOUGH = 0.5
# Around a photo the render is darker.
_AROUND = 0.35


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo to compare with.

    Attributes:
        pixels: (h, w, 3) uint8 of the size of ``placed``.
        placed: where it lies in the picture.
    """

    pixels: Tensor
    placed: Placed


@torch.no_grad()
def draw(
    gaussians: Gaussians,
    camera: Camera,
    look: Look,
    background: Tensor | None = None,
    photo: Photo | None = None,
) -> np.ndarray:
    """(H, W, 3) uint8: the Gaussians as ``look`` wants to see them, from ``camera``.

    ``background`` (3,) in 0..1 is black where there is none. The mode "error" needs a photo;
    without one it shows colours.
    """
    with single_threaded():
        picture = _modes(gaussians, camera, look, background, photo)
        if photo is not None:
            picture = _beside(picture, photo, look)
        return picture.contiguous().numpy()  # on the CPU, whatever the Gaussians are on


def _modes(
    gaussians: Gaussians, camera: Camera, look: Look, background: Tensor | None, photo: Photo | None
) -> Tensor:
    """(H, W, 3) uint8, on the CPU."""
    if background is not None:
        background = background.to(gaussians.means.device)
    if look.scale != 1.0 and look.mode != "points":
        log_scales = gaussians.log_scales + math.log(look.scale)
        gaussians = dataclasses.replace(gaussians, log_scales=log_scales)
    splats = project(gaussians, camera, look.sh_degree).without_empty_rows()
    if look.crop is not None:
        splats = _cropped(splats, gaussians, look.crop)
    size = camera.width, camera.height
    if look.mode == "depth":
        _, alpha, depth = ops.rasterize(splats, *size, background, with_depth=True)
        assert depth is not None
        return _depth(depth, alpha)
    if look.mode == "alpha":
        _, alpha, _ = ops.rasterize(splats, *size)
        return _bytes(alpha)[:, :, None].expand(-1, -1, 3)
    if look.mode == "normals":
        return _normals(splats, gaussians, camera)
    if look.mode == "points":
        splats = _as_points(splats)
    elif look.mode == "ellipsoids":
        splats = _as_ellipsoids(splats, gaussians, camera)
    elif look.mode == "cost":
        counts = ops.count_blended(splats, *size)
        return palette.HEAT[_steps(torch.log1p(counts) / math.log1p(_MANY))]
    image, _, _ = ops.rasterize(splats, *size, background)
    if look.mode == "error" and photo is not None:
        return _error(image.cpu(), photo)
    return _bytes(image)


def _bytes(values: Tensor) -> Tensor:
    """0..1 to uint8, rounded to the nearest, on the CPU."""
    return values.clamp(0.0, 1.0).mul_(255.0).add_(0.5).to(torch.uint8).cpu()


def _steps(values: Tensor) -> Tensor:
    """0..1 to places in a palette."""
    return _bytes(values.nan_to_num()).long()


def _cropped(
    splats: Splats2D,
    gaussians: Gaussians,
    crop: tuple[tuple[float, float, float], tuple[float, float, float]],
) -> Splats2D:
    """Those whose centres lie in the box."""
    low, high = (gaussians.means.new_tensor(corner) for corner in crop)
    assert splats.ids is not None
    means = gaussians.means[splats.ids.long()]
    inside = ((means >= low) & (means <= high)).all(1).nonzero()[:, 0]
    return Splats2D(splats.packed[inside], splats.ids[inside], splats.channels)


def _depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Even steps of disparity, 1/z, between the nearest and the farthest, but for 1% each."""
    shown = alpha >= _OPAQUE_ENOUGH
    disparity = alpha / depth.clamp_min(1e-9)
    some = disparity[::4, ::4][shown[::4, ::4]]
    if not len(some):
        return torch.zeros(*depth.shape, 3, dtype=torch.uint8)
    far, near = torch.quantile(some[:: 1 + len(some) // 10_000], some.new_tensor([0.01, 0.99]))
    share = (disparity - far) / (near - far).clamp_min(1e-6 * float(near))
    return palette.DEPTH[_steps(share)] * shown[:, :, None].cpu()


def _axes(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """The shortest axis (M, 3) of each splat's Gaussian, camera frame, towards the camera, and how
    straight it points there, (M,) in 0..1."""
    assert splats.ids is not None
    ids = splats.ids.long()
    unit = torch.eye(3, dtype=gaussians.quats.dtype, device=gaussians.quats.device)
    shortest = unit[gaussians.log_scales[ids].argmin(1)]
    axes = _rotated(gaussians.rotations[ids], shortest)
    to_camera = camera.position.to(axes) - gaussians.means[ids]
    facing = (axes * to_camera).sum(1)
    axes = torch.where(facing[:, None] < 0, -axes, axes)
    straight = facing.abs() / to_camera.norm(dim=1).clamp_min(1e-9)
    return axes @ camera.cam_from_world[:, :3].T.to(axes), straight


def _rotated(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (M, 3) turned by unit quaternions wxyz (M, 4): v + 2 q × (q × v + w v)."""
    w, q = quats[:, :1], quats[:, 1:]
    return vectors + 2.0 * torch.linalg.cross(q, torch.linalg.cross(q, vectors) + w * vectors)


def _recolored(splats: Splats2D, colors: Tensor) -> Splats2D:
    packed = splats.packed.clone()
    packed[:, COLORS : COLORS + 3] = colors
    return Splats2D(packed, splats.ids, splats.channels)


def _normals(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Red: to the right, green: up, blue: to the camera."""
    axes, _ = _axes(splats, gaussians, camera)
    # Blended as they are, then of unit length: the direction of the mean.
    image, alpha, _ = ops.rasterize(_recolored(splats, axes), camera.width, camera.height)
    length = image.permute(2, 0, 1).square().sum(0).sqrt_().clamp_min_(1e-9)  # plane by plane
    normals = image / length[:, :, None] * image.new_tensor([0.5, -0.5, -0.5])
    return _bytes((normals + 0.5) * (alpha >= _OPAQUE_ENOUGH)[:, :, None])


def _as_points(splats: Splats2D) -> Splats2D:
    """A dot for each, of its colour."""
    packed = splats.packed.clone()
    packed[:, CONICS] = packed.new_tensor([1.0, 0.0, 1.0]) / _DOT**2
    packed[:, OPACITIES] = 1.0
    return Splats2D(packed, splats.ids, splats.channels)


def _as_ellipsoids(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> Splats2D:
    """Opaque discs with a sharp edge, the darker the more they are seen from the side."""
    assert splats.ids is not None
    _, straight = _axes(splats, gaussians, camera)
    shortest, middle = gaussians.log_scales[splats.ids.long()].sort(1).values[:, :2].unbind(1)
    roundness = torch.exp(shortest - middle)  # what is round has no side
    light = 0.4 + 0.6 * (straight + (1.0 - straight) * roundness)
    packed = splats.packed.clone()
    packed[:, COLORS : COLORS + 3] *= light[:, None]
    opaque = (packed[:, OPACITIES] >= _ELLIPSOID_OPACITY).nonzero()[:, 0]
    packed = packed[opaque]
    packed[:, CONICS] *= 2.0 * _DISC / _ELLIPSOID_END**2
    packed[:, OPACITIES] = math.exp(_DISC)
    return Splats2D(packed, splats.ids[opaque], splats.channels)


def _error(image: Tensor, photo: Photo) -> Tensor:
    """How far the colours are from the photo's; around it the render."""
    picture = _bytes(image)
    at = photo.placed
    rows, columns = slice(at.top, at.top + at.height), slice(at.left, at.left + at.width)
    seen, there = picture[rows, columns].to(torch.float32), photo.pixels.to(torch.float32)
    error = (seen - there).abs_().mean(2) / (255.0 * _WORST)
    picture[rows, columns] = palette.HEAT[_steps(error)]
    return picture


def _beside(picture: Tensor, photo: Photo, look: Look) -> Tensor:
    """The photo from its left edge as far as the wipe, a line there, and darkness around."""
    at = photo.placed
    rows, columns = slice(at.top, at.top + at.height), slice(at.left, at.left + at.width)
    inside = picture[rows, columns].clone()
    edge = round(look.wipe * at.width)
    inside[:, :edge] = photo.pixels[:, :edge]
    if 0 < edge < at.width:
        inside[:, max(0, edge - 1) : edge + 1] = 255
    whole = (picture.to(torch.float32) * _AROUND).to(torch.uint8)
    whole[rows, columns] = inside
    return whole
