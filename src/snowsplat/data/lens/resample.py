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

_STEPS = 32  # OpenCV divides a pixel into so many positions along each axis
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
    pixels = np.pad(planes.transpose(1, 2, 0), ((0, 0), (margin, margin), (0, 0)), mode="wrap")
    for rows, position in view.strips(width, height):
        position *= np.array(scale, np.float32)
        position[..., 0] += margin
        np.nan_to_num(position, copy=False, nan=-1.0)
        made[:, rows] = _catmull_rom(pixels, position).transpose(2, 0, 1)
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


def _catmull_rom(pixels: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(H, W, C): a photo (h, w, C) uint8 at positions (H, W, 2) float32, to 1/32 of a pixel.

    Kernels of cubic convolution have a free parameter a: the kernel is K₀ + a·G. OpenCV uses
    a = −0.75, which sharpens. Catmull-Rom uses a = −0.5, which is exact for quadratics (Keys 1981).
    So the kernel of Catmull-Rom is 1/3 of K₀ plus 2/3 of OpenCV's. K₀ uses two pixels: it is
    bilinear interpolation with each fraction f replaced by 3f² − 2f³. (Here the results of the 2D
    interpolations are added instead of the 1D kernels. This leaves an error of the fourth order.)

    Changes ``position``.
    """
    top, bottom = _needed(position[..., 1], pixels.shape[0])
    left, right = _needed(position[..., 0], pixels.shape[1])
    part = pixels[top:bottom, left:right]
    position -= np.array([left + 0.5, top + 0.5], np.float32)
    whole, fraction = cv2.convertMaps(position, None, cv2.CV_16SC2)  # type: ignore[call-overload]
    border = cv2.BORDER_REPLICATE
    cubic = cv2.remap(part, whole, fraction, cv2.INTER_CUBIC, borderMode=border)
    bent = cv2.remap(part, whole, _BENT[fraction], cv2.INTER_LINEAR, borderMode=border)
    made: np.ndarray = cv2.addWeighted(cubic, 2 / 3, bent, 1 / 3, 0)
    return made.reshape(*position.shape[:2], -1)


def _needed(position: np.ndarray, size: int) -> tuple[int, int]:
    """The pixels of an axis that positions need: the first, and one beyond the last."""
    first = int(np.clip(position.min() - _MARGIN, 0, size - 1))
    return first, int(np.clip(position.max() + _MARGIN, first + 1, size))


def _bent_fractions() -> np.ndarray:
    """For each of OpenCV's fractions, 32·y + x in 1/32 pixels, that of 3f² − 2f³ of both axes."""
    f = np.arange(_STEPS) / _STEPS
    bent = np.minimum(np.rint(_STEPS * f * f * (3 - 2 * f)), _STEPS - 1)
    return (_STEPS * bent[:, None] + bent).ravel().astype(np.uint16)


_BENT = _bent_fractions()
