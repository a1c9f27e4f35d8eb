"""Discontinuities of a depth map: where two neighbouring pixels are not on the same surface.

A surface that is stretched across a discontinuity is visible as a rubber sheet from other
viewpoints. Two neighbours are linked if their depths are similar. Everything that needs a
neighbourhood (tangents, merging of pixels, resizing) uses linked pixels only.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.extras.lift.options import EDGE_THRESHOLD

# Radius in pixels of the window in which `snap_to_surfaces` looks for the two surfaces. Networks
# blur a discontinuity over about this number of pixels on each side.
_SNAP_RADIUS = 2


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
