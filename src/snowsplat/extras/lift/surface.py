"""The surface that a depth map describes: a point and two tangents for each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.extras.lift.edges import Links
from snowsplat.scene.camera import Camera

# Largest change of the depth from a pixel to the next, in units of the width of the pixel at that
# depth. 4 is a surface at 76° from the image plane. Steeper surfaces are mostly errors of the
# depth map. Their discs would be long needles from other viewpoints.
_STEEPEST = 4.0


@dataclass(frozen=True)
class Surface:
    """A point and two tangents for each pixel, in the camera frame, in world units."""

    # (H, W, 3) the points at the centres of the pixels; differentiable with respect to the depth.
    # NaN where the depth is unknown.
    points: Tensor
    # (H, W, 3, 2) the derivatives of the points with respect to the column and the row, in world
    # units per pixel. They are constants for autograd.
    tangents: Tensor


def surface_of(depth: Tensor, camera: Camera, links: Links) -> Surface:
    """The surface of a depth map.

    The point of a pixel is P(u, v) = z(u, v) r(u, v), where r is the direction of its ray with z
    component 1. The tangents are ∂P/∂u = r ∂z/∂u + z ∂r/∂u, and the same for v. The derivatives of
    z are computed from linked neighbours, in disparity 1/z, which is linear on planes. A pixel
    without a linked neighbour in a row (column) is parallel to the image plane in that direction.

    ``depth``: (H, W) camera z in world units, positive; NaN where it is unknown.
    """
    height, width = depth.shape
    u = (torch.arange(width, dtype=depth.dtype) + 0.5 - camera.cx) / camera.fx
    v = (torch.arange(height, dtype=depth.dtype) + 0.5 - camera.cy) / camera.fy
    v, u = torch.meshgrid(v, u, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], dim=-1)
    with torch.no_grad():
        z = depth.detach()
        per_column = _slope(z, links.right, camera.fx)
        per_row = _slope(z.T, links.down.T, camera.fy).T
        tangents = torch.stack([rays * per_column[..., None], rays * per_row[..., None]], dim=-1)
        tangents[..., 0, 0] += z / camera.fx
        tangents[..., 1, 1] += z / camera.fy
    return Surface(rays * depth[..., None], tangents)


def _slope(depth: Tensor, right: Tensor, focal: float) -> Tensor:
    """∂z/∂u (H, W), in world units per pixel: the mean over the linked sides, limited."""
    disparity = 1.0 / depth
    step = torch.where(right, disparity[:, 1:] - disparity[:, :-1], 0.0)
    sides = F.pad(right.to(depth.dtype), (1, 0)) + F.pad(right.to(depth.dtype), (0, 1))
    mean = (F.pad(step, (1, 0)) + F.pad(step, (0, 1))) / sides.clamp_min(1.0)
    limit = _STEEPEST * depth / focal
    return torch.clamp(-depth * depth * mean, -limit, limit)  # dz = -z² d(1/z)
