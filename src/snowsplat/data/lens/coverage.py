"""`covered_pixels`: the pixels of a view that the photo shows."""

from __future__ import annotations

import numpy as np

from snowsplat.data.lens.positions import Positions
from snowsplat.data.lens.views import LensView

_SAMPLES = 2  # of a pixel along each axis


def covered_pixels(view: LensView | None, width: int, height: int) -> np.ndarray:
    """(height, width) bool: the pixels of a view at this size that lie completely in the photo.

    None: a photo without distortion, all of whose pixels are shown.
    """
    made: np.ndarray = np.ones((height, width), bool)
    if view is None or not view.partial:
        return made
    for rows, positions in view.positions(_SAMPLES * width, _SAMPLES * height):
        part = made[rows.start // _SAMPLES : rows.stop // _SAMPLES]
        # The photo and its circle are convex. Only cells at their border need a test of each pixel.
        inside, outside = _sides(view, positions.nodes)
        part[...] = _every(inside, positions)
        y, x = np.nonzero(_every(~outside, positions) & ~part)
        sample = np.arange(_SAMPLES)
        x, y = (_SAMPLES * at[:, None, None] + sample for at in (x, y))
        at = positions.at(x, y.transpose(0, 2, 1))
        part[y[:, 0, 0] // _SAMPLES, x[:, 0, 0] // _SAMPLES] = view.covered(at).all((1, 2))
    return made


def _sides(view: LensView, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cells that lie completely inside of the photo and its circle, and those outside."""
    corners = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]])
    low, high = corners.min(0), corners.max(0)  # NaN if a corner is
    inside = np.logical_and.reduce([view.covered(corner) for corner in corners])
    size = view.lens.width, view.lens.height
    outside = ~((high >= 0) & (low <= size)).all(-1)
    if view.circle is not None:
        centre = np.array(view.lens.intrinsics[2:])
        outside |= np.linalg.norm(centre.clip(low, high) - centre, axis=-1) > view.circle
    return inside, outside


def _every(cells: np.ndarray, positions: Positions) -> np.ndarray:
    """The pixels all of whose samples are in ``cells`` (n − 1, m − 1) bool."""
    for axis, nodes in enumerate((positions.row, positions.column)):
        samples = nodes.reshape(-1, _SAMPLES).T
        cells = np.logical_and.reduce([cells.take(sample, axis) for sample in samples])
    return cells
