"""Resamples photos and masks for a pinhole view. The centre of the first pixel is at (0.5, 0.5).

Photos are sampled with Catmull-Rom splines, which have at most a third of the error of bilinear
interpolation. Training uses every pixel, so blur added here would limit its quality.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import cv2
import numpy as np
from PIL import Image

from snowsplat.data.lens.pinhole import Pinhole
from snowsplat.data.lens.views import LensView

_MARGIN = 3  # pixels beside a pixel that its spline may need


class PixelMap(Protocol):
    """From the pixels of a view to those of a photo: a `Pinhole` or a `LensView`."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def wraps(self) -> bool: ...

    def strips(self, width: int, height: int) -> Iterator[tuple[slice, np.ndarray]]:
        """See `LensView.strips`."""
        ...


def undistort_image(image: Image.Image, view: PixelMap) -> Image.Image:
    """A photo, "L", "RGB" or "RGBA", resampled to the view; same mode."""
    if isinstance(view, Pinhole) and view.nodes is None:
        return image
    # Premultiplied alpha, so that the colours of transparent pixels do not affect other pixels.
    mode = "RGBa" if image.mode == "RGBA" else image.mode
    pixels = np.asarray(image.convert(mode)).reshape(image.height, image.width, -1)
    made = resampled(pixels.transpose(2, 0, 1), view, view.width, view.height)
    pixels = np.ascontiguousarray(made.transpose(1, 2, 0))
    return Image.frombytes(mode, (view.width, view.height), pixels.tobytes()).convert(image.mode)


def undistort_mask(mask: Image.Image, view: PixelMap) -> Image.Image:
    """A mask, "L", resampled to the view: 255 where at least half of a pixel is set."""
    return undistort_image(mask, view).point(lambda value: 255 * (value >= 128))


def resampled(
    planes: np.ndarray, view: PixelMap, width: int, height: int, scale: tuple[float, float] = (1, 1)
) -> np.ndarray:
    """(C, height, width) uint8: a photo (C, H, W) uint8 seen by a view at the given size.

    ``scale``: the size of the photo divided by that of the lens, for x and y. Positions outside of
    the photo get the colour of its border.
    """
    made: np.ndarray = np.empty((len(planes), height, width), np.uint8)
    margin = _MARGIN if view.wraps else 0
    if margin:
        planes = np.pad(planes, ((0, 0), (0, 0), (margin, margin)), mode="wrap")
    for rows, position in view.strips(width, height):
        position = np.nan_to_num(position * np.array(scale, np.float32), copy=False, nan=-1.0)
        position[..., 0] += margin
        _sample(planes, position, made[:, rows])
    return made


def nearest(values: np.ndarray, view: LensView, width: int, height: int) -> np.ndarray:
    """(height, width) float32: a map (H, W) of a photo, such as its depth, seen by a view.

    Nearest values, because a mean of two surfaces is on neither. NaN where the photo shows nothing.
    """
    scale = np.array([values.shape[1] / view.lens.width, values.shape[0] / view.lens.height])
    made = np.full((height, width), np.nan, np.float32)
    for rows, position in view.strips(width, height):
        shown = view.covered(position) & np.isfinite(position).all(-1)
        column, row = np.floor(position[shown] * scale).astype(np.int64).T
        column, row = column.clip(0, values.shape[1] - 1), row.clip(0, values.shape[0] - 1)
        made[rows][shown] = values[row, column]
    return made


def _sample(planes: np.ndarray, position: np.ndarray, out: np.ndarray) -> None:
    """Catmull-Rom splines at positions (H, W, 2) of a photo (C, h, w), to ``out`` (C, H, W).

    Kernels of cubic convolution have a free parameter a: the kernel is K₀ + a·G. OpenCV uses
    a = −0.75, which sharpens. Catmull-Rom uses a = −0.5, which is exact for quadratics (Keys 1981).
    So the kernel of Catmull-Rom is 1/3 of K₀ plus 2/3 of OpenCV's. K₀ uses two pixels: it is
    bilinear interpolation with each fraction f replaced by 3f² − 2f³. (Here the results of the 2D
    interpolations are added instead of the 1D kernels. This leaves an error of the fourth order.)
    """
    height, width = planes.shape[1:]
    top, bottom = _needed(position[..., 1], height)
    left, right = _needed(position[..., 0], width)
    part = np.ascontiguousarray(planes[:, top:bottom, left:right].transpose(1, 2, 0))
    position = position - np.array([left + 0.5, top + 0.5], np.float32)
    cubic = _remap(part, position, cv2.INTER_CUBIC)
    whole = np.floor(position)
    position -= whole
    position *= position * (3 - 2 * position)
    position += whole
    bent = _remap(part, position, cv2.INTER_LINEAR)
    made = cv2.addWeighted(cubic, 2 / 3, bent, 1 / 3, 0).reshape(*position.shape[:2], -1)
    out[...] = made.transpose(2, 0, 1)


def _remap(part: np.ndarray, position: np.ndarray, how: int) -> np.ndarray:
    made: np.ndarray = cv2.remap(  # type: ignore[call-overload]
        part, position, None, how, borderMode=cv2.BORDER_REPLICATE
    )
    return made


def _needed(position: np.ndarray, size: int) -> tuple[int, int]:
    """The pixels of an axis that positions need: the first, and one beyond the last."""
    first = int(np.clip(position.min() - _MARGIN, 0, size - 1))
    return first, int(np.clip(position.max() + _MARGIN, first + 1, size))
