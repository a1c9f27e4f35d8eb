"""The surface that a depth map describes: a point and two tangents for each pixel.

A surface that is stretched across a discontinuity, where two neighbouring pixels are not on the
same surface, is visible as a rubber sheet from other viewpoints. Two neighbours are linked if their
depths are similar. Everything that needs a neighbourhood (tangents, merging of pixels, resizing)
uses linked pixels only.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.extras.lift.options import EDGE_THRESHOLD
from snowsplat.scene.camera import Camera

# Largest change of the depth from a pixel to the next, in units of the width of the pixel at that
# depth. 4 is a surface at 76° from the image plane. Steeper surfaces are mostly errors of the
# depth map. Their discs would be long needles from other viewpoints.
_STEEPEST = 4.0
# Radius in pixels of the window in which `snap_to_surfaces` looks for the two surfaces. Networks
# blur a discontinuity over about this number of pixels on each side.
_SNAP_RADIUS = 2


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


@dataclass(frozen=True)
class Links:
    """Which neighbouring pixels are on the same surface."""

    right: Tensor  # (H, W - 1) bool: pixel (i, j) and pixel (i, j + 1)
    down: Tensor  # (H - 1, W) bool: pixel (i, j) and pixel (i + 1, j)


def find_links(depth: Tensor, threshold: float = EDGE_THRESHOLD) -> Links:
    """Link neighbours whose depths differ by at most ``threshold`` of the larger one.

    ``depth``: (H, W) positive; NaN where it is unknown. Such pixels have no links.
    """

    def similar(a: Tensor, b: Tensor) -> Tensor:
        return (a - b).abs() <= threshold * torch.maximum(a, b)

    return Links(similar(depth[:, :-1], depth[:, 1:]), similar(depth[:-1], depth[1:]))


def snap_to_surfaces(depth: Tensor, threshold: float = EDGE_THRESHOLD) -> Tensor:
    """Move pixels that are between two surfaces to the closer one.

    Networks and filters blur depth maps. A pixel at an edge then has a depth between that of the
    object and that of the background, where there is no surface. A pixel is moved if it is linked
    to neither of its neighbours in a row or a column, and its depth is between theirs.

    ``depth``: (H, W) positive; NaN where it is unknown. Pixels on surfaces keep their depth.
    """
    links = find_links(depth, threshold)
    between = _between(depth, links.right) | _between(depth.T, links.down.T).T
    size = 2 * _SNAP_RADIUS + 1
    known = depth.isfinite()

    def largest(values: Tensor) -> Tensor:
        filled = torch.where(known, values, -torch.inf)
        padded = F.pad(filled[None, None], [_SNAP_RADIUS] * 4, value=-torch.inf)
        return F.max_pool2d(padded, size, 1)[0, 0]

    far, near = largest(depth), -largest(-depth)
    closer = torch.where(depth * depth < near * far, near, far)  # in the logarithm of the depth
    return torch.where(between & known, closer, depth)


def _between(depth: Tensor, right: Tensor) -> Tensor:
    """(H, W) bool: unlinked on the left and on the right, and between the depths there."""
    left, middle, next_ = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
    monotone = (next_ - middle) * (middle - left) > 0
    return F.pad(monotone & ~right[:, :-1] & ~right[:, 1:], (1, 1))


def resize_depth(
    depth: Tensor, width: int, height: int, threshold: float = EDGE_THRESHOLD
) -> Tensor:
    """(height, width): the depth map (H, W) at another size: bilinear on surfaces, the nearest
    value at discontinuities. Depths are positive; NaN where they are unknown.
    """
    if depth.shape == (height, width):
        return depth
    size = (height, width)
    nearest = F.interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]
    # Disparity is linear on planes.
    smooth = 1.0 / F.interpolate(1.0 / depth[None, None], size, mode="bilinear")[0, 0]
    step = max(1.0, depth.shape[1] / width, depth.shape[0] / height)
    similar = (smooth - nearest).abs() <= 0.5 * threshold * step * nearest
    return torch.where(similar, smooth, nearest)
