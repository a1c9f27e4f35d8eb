"""The pinhole camera of an undistorted photo.

It is chosen so that the undistorted image has no blank borders and no folded parts, for every
calibration that SfM may return.
"""

from dataclasses import dataclass, replace

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.positions import node_grid
from snowsplat.util.errors import Problem

_CROPPED = 0.95  # of width and height; without blank borders, an image shows more of the photo
_BORDER_SAMPLES = 513  # positions on each border of a photo, among them the corners and the middle
_MIN_FRACTION = 0.2  # of width and height: if less can be undistorted, the calibration is wrong


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion."""

    width: int  # pixels
    height: int
    params: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    cropped: bool = False  # the outer part is cut off, because the calibration is invalid there


def pinhole_of(lens: Lens) -> Pinhole:
    """The pinhole camera for a distorted one: the same focal lengths, no blank borders.

    Raises: ValueError: the calibration is valid only for a small part of the photo.
    """
    fx, fy, cx, cy = lens.intrinsics
    if lens.is_pinhole:
        return Pinhole(lens.width, lens.height, (fx, fy, cx, cy))
    made = _without_blank_borders(lens)
    if not _is_valid(lens, made):
        # Beyond some radius the distortion polynomial may decrease, so that the image is folded
        # there. If the size of the image is limited, it may have blank borders. Search for the
        # largest part around the principal point without folds and blank borders.
        whole = Pinhole(2 * lens.width, 2 * lens.height, (fx, fy, 2 * cx, 2 * cy))
        low, high = 0.0, 1.0
        while high - low > 1e-3:
            middle = (low + high) / 2
            part = _shrunk(whole, middle)
            if part is not None and _is_valid(lens, part):
                low, made = middle, part
            else:
                high = middle
        min_width, min_height = _MIN_FRACTION * lens.width, _MIN_FRACTION * lens.height
        if low == 0 or made.width < min_width or made.height < min_height:
            raise Problem("less than a fifth of the width or height can be undistorted")
    nodes = node_grid(made.width, made.height, lambda x, y: _to_photo(lens, made, x, y))
    used = np.ptp(nodes, axis=(0, 1)) / (lens.width, lens.height)
    return replace(made, cropped=bool(used.min() < _CROPPED))


def _without_blank_borders(lens: Lens) -> Pinhole:
    """The image of 0.2 to 2 times the size of the photo that has no blank borders, as in COLMAP.

    The border of the photo is mapped to the pinhole camera of the same parameters. On each side,
    the innermost position is the border of the new image, which keeps the shares of the principal
    point.
    """
    fx, fy, cx, cy = lens.intrinsics
    sides = []
    for size, other, centre, focal, axis in (
        (lens.width, lens.height, cx, fx, 0),
        (lens.height, lens.width, cy, fy, 1),
    ):
        along = np.linspace(0.5, other - 0.5, min(other, _BORDER_SAMPLES))
        near, far = (
            lens.unproject(np.stack([across, along] if axis == 0 else [along, across], -1))
            for across in (np.full_like(along, 0.5), np.full_like(along, size - 0.5))
        )
        inner = -focal * near[:, axis].max(), focal * far[:, axis].min()
        outer = centre, size - 0.5 - centre
        with np.errstate(all="ignore"):
            scale = float(np.divide(inner, outer).min())
        sides.append(max(1, int(size * np.clip(scale, 0.2, 2.0))) if scale > 0 else 2 * size)
    width, height = sides
    params = (fx, fy, cx * width / lens.width, cy * height / lens.height)
    return Pinhole(width, height, params)


def _to_photo(lens: Lens, pinhole: Pinhole, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(len(y), len(x), 2): positions of undistorted pixels in the photo, in pixels. NaN where the
    lens model is undefined."""
    fx, fy, cx, cy = pinhole.params
    across, down = np.meshgrid((x - cx) / fx, (y - cy) / fy)
    return lens.project(np.stack([across, down, np.ones_like(across)], -1))


def _shrunk(pinhole: Pinhole, factor: float) -> Pinhole | None:
    """The part around the principal point whose size is ``factor`` times the size of the image."""
    width, height = int(factor * pinhole.width), int(factor * pinhole.height)
    if width < 1 or height < 1:
        return None
    fx, fy, cx, cy = pinhole.params
    params = (fx, fy, cx * width / pinhole.width, cy * height / pinhole.height)
    return Pinhole(width, height, params)


def _is_valid(lens: Lens, pinhole: Pinhole) -> bool:
    """Whether every pixel of the undistorted image is in the photo, without folds or gaps."""
    x, y = (np.linspace(0, size, 65) for size in (pinhole.width, pinhole.height))
    source = _to_photo(lens, pinhole, x, y)
    if not np.isfinite(source).all():
        return False
    # Because sizes are rounded, positions up to one pixel outside of the photo are allowed. There,
    # the border pixels of the photo are repeated.
    if (source < -1).any() or (source > [lens.width + 1, lens.height + 1]).any():
        return False
    right, down = source[:-1, 1:] - source[:-1, :-1], source[1:, :-1] - source[:-1, :-1]
    area = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    # A cell must have at least 1% of the area of the central cell: if it is stretched more, it has
    # no usable detail.
    return bool(area.min() > 0.01 * area[32, 32] > 0)
