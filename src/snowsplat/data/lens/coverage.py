"""What a photo shows: the image circle of its lens, and the pixels of a view that are in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.positions import Positions
from snowsplat.data.lens.views import LensView

_SAMPLES = 2  # of a pixel along each axis
# Of 255: outside of the circle no photo is brighter, except for JPEG artefacts and noise.
_BLACK = 24
# Share of the pixels outside of the circle that must be black.
_ALL = 0.995
# Share of the photo outside of the circle; less is not worth a mask.
_LEAST = 0.005
# The rim of the circle is dark and blurred. Relative to its radius.
_RIM = 0.01
_RINGS = 256


def image_circle(lens: Lens, photos: Sequence[np.ndarray]) -> float | None:
    """The radius of the image circle around the principal point, in pixels of the lens.

    The corners are black in all photos. None: the circle is larger than the photo.

    Args:
        lens: of the photos.
        photos: (C, h, w) uint8 of any one size, with different contents.
    """
    if not photos:
        return None
    brightest = np.max([photo[:3].max(0) for photo in photos], axis=0)
    height, width = brightest.shape
    _, _, cx, cy = lens.intrinsics
    x = (np.arange(width) + 0.5) * (lens.width / width) - cx
    y = (np.arange(height) + 0.5) * (lens.height / height) - cy
    radius = np.hypot(x, y[:, None])
    farthest = float(radius.max())
    ring = np.minimum((radius * (_RINGS / farthest)).astype(np.int64), _RINGS - 1)
    count = np.bincount(ring.ravel(), minlength=_RINGS)
    bright = np.bincount(ring.ravel(), (brightest > _BLACK).ravel(), minlength=_RINGS)
    # For each ring, the pixels from this ring to the corners.
    outside = np.cumsum(count[::-1])[::-1]
    black = np.cumsum(bright[::-1])[::-1] <= (1 - _ALL) * outside
    rings = np.flatnonzero(black & (outside >= _LEAST * radius.size))
    if not len(rings) or rings[0] == 0:
        return None
    return float(rings[0] / _RINGS * farthest) * (1 - _RIM)


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
