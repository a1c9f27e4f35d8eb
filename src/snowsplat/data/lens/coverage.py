"""What a photo shows: the image circle of its lens, and the pixels of a view that are in it."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.views import LensView

_SAMPLES = 2  # of a pixel along each axis
_KEPT = 8  # views at a size, whose covered pixels are kept
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


@lru_cache(_KEPT)
def covered_pixels(view: LensView | None, width: int, height: int) -> np.ndarray:
    """(height, width) bool: the pixels of a view at this size that lie completely in the photo.

    None: a photo without distortion, all of whose pixels are shown. The array is not to be changed.
    """
    made: np.ndarray = np.ones((height, width), bool)
    if view is not None and view.partial:
        samples = np.ones((_SAMPLES * height, _SAMPLES * width), bool)
        for rows, positions in view.strips(_SAMPLES * width, _SAMPLES * height):
            samples[rows] = view.covered(positions)
        made = np.asarray(samples.reshape(height, _SAMPLES, width, _SAMPLES).all((1, 3)))
    made.flags.writeable = False
    return made
