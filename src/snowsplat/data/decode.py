"""One image file: its header, its pixels as planes, its smaller copies.

Everything here is a pure function of the file, so it may run in any thread and at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from snowsplat.data.image_file import open_image, reason_of
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file

# What photographs come as (a phone's MPO counts as JPEG). Pillow also knows formats that start
# other programs.
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
_BAND_PIXELS = 1 << 20  # what is held at a time while pixels are rearranged
#: The endings that are tried where a dataset names its images without one.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")
_EXIF_ORIENTATION = 0x0112


@dataclass(frozen=True)
class ImageSource:
    """An image that stays on disk until it is wanted, and the size it is then brought to.

    ``turn``: apply the orientation that the camera noted in the file. Off unless the sizes prove
    that the pose was made for the turned picture: COLMAP poses are made for the pixels as stored.
    ``stored``: how many pixels are decoded for it; 0: not known, as many as are wanted.
    """

    path: Path
    width: int
    height: int
    turn: bool = False
    stored: int = 0


@dataclass(frozen=True)
class LoadedImage:
    """A decoded image: 8-bit planes. Colours of transparent images are multiplied by alpha."""

    planes: Tensor  # (3, H, W) uint8 RGB, or (4, H, W) RGBA, premultiplied
    mask: Tensor | None = None  # (H, W) bool: False where the image does not count

    @property
    def rgb(self) -> Tensor:
        """(H, W, 3) uint8, planar in memory. Premultiplied where there is alpha; see `over`."""
        return self.planes[:3].permute(1, 2, 0)

    @property
    def alpha(self) -> Tensor | None:
        """(H, W) uint8, or None for an opaque image."""
        return self.planes[3] if self.planes.shape[0] == 4 else None

    def over(self, background: Tensor) -> Tensor:
        """(H, W, 3) float32 in 0..1, planar in memory: the image over a background colour (3,)."""
        planes = self.planes.to(torch.float32) / 255.0
        if planes.shape[0] == 4:
            planes = planes[:3] + (1.0 - planes[3]) * background.to(torch.float32)[:, None, None]
        return planes.permute(1, 2, 0)

    def to(self, device: torch.device) -> LoadedImage:
        """On another device; no copy where it is there already."""
        mask = None if self.mask is None else self.mask.to(device)
        return LoadedImage(self.planes.to(device), mask)

    @property
    def nbytes(self) -> int:
        return self.planes.nbytes + (0 if self.mask is None else self.mask.nbytes)


@dataclass(frozen=True)
class Header:
    """What an image file says of itself without being decoded."""

    width: int  # pixels, as stored
    height: int
    sideways: bool  # its EXIF orientation exchanges width and height


def read_header(path: Path) -> Header:
    """Size and orientation of an image file; cheap.

    Raises:
        UserError: absent, or not an image that can be read.
    """
    try:
        with open_image(path, _FORMATS, header_only=True) as image:
            # Where a PNG has no such note up front, getexif() would decode all of it to find one.
            noted = "exif" in image.info or image.format == "TIFF"
            orientation = image.getexif().get(_EXIF_ORIENTATION, 1) if noted else 1
            return Header(image.width, image.height, sideways=orientation in (5, 6, 7, 8))
    except Exception as error:  # Pillow's parsers raise anything on damaged files
        raise _unreadable(path, error) from None


def load_image(source: ImageSource, background: Sequence[float] | None = None) -> Tensor:
    """Decode to planes (3, H, W) uint8, or (4, H, W) premultiplied RGBA.

    Four planes come only from an image that is somewhere transparent, and only if no ``background``
    (three numbers in 0..1) is given to compose it over.

    Raises:
        UserError: absent, damaged, or not an image.
    """
    try:
        with open_image(source.path, _FORMATS) as opened:
            image = ImageOps.exif_transpose(opened) if source.turn else opened
            planes = _planes(image)
    except Exception as error:  # as above
        raise _unreadable(source.path, error) from None
    if planes.shape[0] == 4:
        planes = _with_alpha(planes, background)
    return torch.from_numpy(resize_area(planes, source.width, source.height))


def load_mask(source: ImageSource) -> Tensor:
    """Decode a mask to (H, W) bool: True where it is rather white than black; transparent is black.

    Raises as `load_image`.
    """
    planes = load_image(source, background=(0.0, 0.0, 0.0))
    return planes.amax(0) >= 128


def box_downscale(image: LoadedImage, factor: int) -> LoadedImage:
    """Box filter: the size is divided by ``factor`` and rounded down (at least 1 pixel).

    A pixel of the mask stays True where all that it covers are.
    """
    if factor == 1:
        return image
    height, width = image.planes.shape[1:]
    size = max(1, width // factor), max(1, height // factor)
    planes = torch.from_numpy(resize_area(image.planes.numpy(), *size))
    mask = None
    if image.mask is not None:
        shares = resize_area(image.mask.numpy()[None].astype(np.uint8) * 255, *size)
        mask = torch.from_numpy(shares[0] == 255)
    return LoadedImage(planes, mask)


def resize_area(planes: np.ndarray, width: int, height: int) -> np.ndarray:
    """(C, H, W) uint8 to (C, height, width): each pixel is the mean of the area that it covers.

    Exact for any ratio, so that intrinsics scaled by each axis' ratio fit the result exactly.
    Meant for making smaller.
    """
    old_height, old_width = planes.shape[1:]
    if (old_width, old_height) == (width, height):
        return planes
    if old_width % width == 0 and old_height % height == 0:
        factors = old_width // width, old_height // height
        return np.stack([np.asarray(Image.fromarray(plane).reduce(factors)) for plane in planes])
    resized = np.empty((planes.shape[0], height, width), np.uint8)
    for plane, out in zip(planes, resized, strict=True):
        rows = _mean_over_columns(plane, width)
        out[...] = np.rint(_mean_over_columns(rows.T, height).T)
    return resized


def _mean_over_columns(values: np.ndarray, count: int) -> np.ndarray:
    """(H, W) to (H, count): means over equal, fractional, stretches of each row."""
    size = values.shape[1]
    edges = np.arange(count + 1) * (size / count)
    whole = np.minimum(edges.astype(np.int64), size - 1)
    part = edges - whole
    means: np.ndarray = np.empty((len(values), count))
    rows = max(1, _BAND_PIXELS // size)
    for top in range(0, len(values), rows):
        band = values[top : top + rows].astype(np.float64)
        # The integral from 0 to each edge, of the row as a step function.
        integral = np.zeros((len(band), size + 1))
        np.cumsum(band, axis=1, out=integral[:, 1:])
        at_edges = integral[:, whole] + part * band[:, whole]
        means[top : top + rows] = np.diff(at_edges, axis=1) * (count / size)
    return means


def _planes(image: Image.Image) -> np.ndarray:
    """(3, H, W) or (4, H, W) uint8, alpha not multiplied."""
    if image.mode.startswith("I"):  # 16-bit grey, which convert() would clip rather than scale
        grey = np.clip(np.asarray(image).astype(np.int64) // 256, 0, 255).astype(np.uint8)
        return np.repeat(grey[None], 3, axis=0)
    if image.mode == "F":
        raise ValueError("floating-point pixels")
    transparent = image.mode in ("RGBA", "RGBa", "LA", "La", "PA") or "transparency" in image.info
    mode = "RGBA" if transparent else "RGB"
    planes: np.ndarray = np.empty((len(mode), image.height, image.width), np.uint8)
    rows = max(1, _BAND_PIXELS // image.width)
    for top in range(0, image.height, rows):
        band = image.crop((0, top, image.width, min(top + rows, image.height)))
        planes[:, top : top + rows] = np.asarray(band.convert(mode)).transpose(2, 0, 1)
    if transparent and planes[3].min() == 255:
        return planes[:3].copy()
    return planes


def _with_alpha(planes: np.ndarray, background: Sequence[float] | None) -> np.ndarray:
    """(4, H, W) straight RGBA to (4, H, W) premultiplied, or to (3, H, W) over the background.

    Changes ``planes``.
    """
    rows = max(1, _BAND_PIXELS // planes.shape[2])
    for top in range(0, planes.shape[1], rows):
        band = planes[:, top : top + rows]
        alpha = band[3].astype(np.float32) / 255
        colours = band[:3] * alpha
        if background is not None:
            behind = 255 * np.asarray(background, np.float32)[:, None, None]
            colours = (colours + (1 - alpha) * behind).clip(0, 255)
        band[:3] = np.rint(colours)
    return planes if background is None else planes[:3].copy()


def _unreadable(path: Path, error: Exception) -> UserError:
    if not is_file(path):
        return UserError(f"{path}: no such image")
    if isinstance(error, PermissionError):
        return UserError(f"{path}: may not be read (permissions)")
    return UserError(
        f"{path}: cannot be decoded ({reason_of(error)}); replace the file or remove it"
    )
