"""Decoding an image file: its header, its pixels as planes, and scaling down.

All functions may run in any thread. The result depends only on the file, and for pixels of 16 bits
on the files beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from torch import Tensor
from torch.nn.functional import pad

from snowsplat.data.lens.coverage import covered_pixels
from snowsplat.data.lens.resample import resample
from snowsplat.data.lens.views import LensView
from snowsplat.data.maps.mask_pixels import mask_levels
from snowsplat.data.photos.bit_depth import eight_bits
from snowsplat.data.photos.colour_profile import is_transparent, to_srgb
from snowsplat.data.photos.image_file import PHOTO_FORMATS, open_image, reason_of
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size
from snowsplat.util.safe_json import is_file

# Pixels are converted in bands of this size, to limit the memory for temporary arrays.
_BAND_PIXELS = 1 << 20
_EXPOSURE = Base.ExposureTime, Base.FNumber, Base.ISOSpeedRatings
# Samples per pixel along each axis when a view of a larger photo is scaled down.
_SAMPLES = 2
#: Suffixes that are tried if a dataset names its images without a suffix.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".avif")


def is_photo(name: str) -> bool:
    """Whether a file name has the suffix of a photo."""
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


@dataclass(frozen=True)
class ImageSource:
    """An image file that is not decoded yet, and the size to which it will be scaled.

    COLMAP estimates poses for the pixels as stored, so ``apply_orientation`` is set only if the
    image size proves that the pose belongs to the rotated image.
    """

    path: Path
    width: int  # pixels, after scaling
    height: int  # pixels, after scaling
    apply_orientation: bool = False  # apply the EXIF orientation
    stored: int = 0  # number of pixels in the file; 0: unknown, then it is width × height
    view: LensView | None = None  # the photo has distortion; the image is this view of it
    blank: bool = False  # a mask without a file: white; ``path`` is that of the photo


@dataclass(frozen=True)
class LoadedImage:
    """A decoded image as 8-bit planes. Colours of transparent images are premultiplied."""

    planes: Tensor  # (3, H, W) uint8 RGB, or (4, H, W) RGBA, premultiplied
    mask: Tensor | None = None  # (H, W) bool: False for pixels to ignore

    @property
    def rgb(self) -> Tensor:
        """(H, W, 3) uint8, planar in memory; premultiplied if the image has alpha."""
        return self.planes[:3].permute(1, 2, 0)

    @property
    def alpha(self) -> Tensor | None:
        """(H, W) uint8; None for an opaque image."""
        return self.planes[3] if self.planes.shape[0] == 4 else None

    def over(self, background: Tensor) -> Tensor:
        """The image composited over ``background``: (H, W, 3) float32 in 0..1, planar in memory.

        Args:
            background: (3,) RGB in 0..1.
        """
        planes = self.planes.to(torch.float32) / 255.0
        if planes.shape[0] == 4:
            planes = planes[:3] + (1.0 - planes[3]) * background.to(torch.float32)[:, None, None]
        return planes.permute(1, 2, 0)

    def to(self, device: torch.device) -> LoadedImage:
        """This image on ``device``; not copied if it is already there."""
        mask = None if self.mask is None else self.mask.to(device)
        return LoadedImage(self.planes.to(device), mask)

    @property
    def nbytes(self) -> int:
        """Memory of planes and mask in bytes."""
        return self.planes.nbytes + (0 if self.mask is None else self.mask.nbytes)


@dataclass(frozen=True)
class Header:
    """The properties of an image file that are known without decoding it."""

    width: int  # pixels, as stored
    height: int  # pixels, as stored
    sideways: bool  # the EXIF orientation swaps width and height


def read_header(path: Path) -> Header:
    """Read the size and orientation of an image file, without decoding it.

    Raises: UserError: the file is missing or is not a readable image.
    """
    with open_photo(path, header_only=True) as image:
        # If a PNG has no EXIF data before its pixels, getexif() would decode it to find some.
        has_exif = "exif" in image.info or image.format == "TIFF"
        orientation = image.getexif().get(Base.Orientation, 1) if has_exif else 1
        return Header(image.width, image.height, sideways=orientation in (5, 6, 7, 8))


def exif_exposure(path: Path) -> float | None:
    """How much light the sensor recorded of a given scene, in EV: log₂(t · ISO / N²).

    One more means a photo of twice the brightness. The zero point is arbitrary.

    Returns: None if exposure time t, f-number N or ISO is missing or not positive, or the file
    cannot be read.
    """
    try:
        with Image.open(path) as image:
            # Without EXIF data before the pixels of a PNG, getexif() would decode them.
            if "exif" not in image.info:
                return None
            details = image.getexif().get_ifd(IFD.Exif)
        time, stop, iso = (float(details[tag]) for tag in _EXPOSURE)
        return math.log2(time * iso / stop**2)
    except Exception:  # Pillow raises many kinds of exceptions for damaged files
        return None


def load_image(source: ImageSource, background: Sequence[float] | None = None) -> Tensor:
    """Decode an image to (3, H, W) uint8 RGB, or to (4, H, W) uint8 premultiplied RGBA.

    The result has four planes only if a pixel is transparent and ``background`` is None.

    Args:
        source: the file and the size of the result.
        background: RGB in 0..1. A transparent image is composited over it.

    Raises: UserError: the file is missing, damaged, or not an image.
    """
    planes = _decode(source, background)
    return torch.from_numpy(_resize_view(planes, source.view, source.width, source.height))


def load_views(
    sources: Sequence[tuple[ImageSource, ImageSource | None]],
    background: Sequence[float] | None = None,
) -> list[LoadedImage]:
    """Several views of one photo with their masks. Each file is decoded once.

    ``background`` and the errors are those of `load_image`.
    """
    planes = _decode(sources[0][0], background)
    levels: dict[Path, np.ndarray] = {}
    made = []
    for source, mask in sources:
        image = torch.from_numpy(_resize_view(planes, source.view, source.width, source.height))
        if mask is not None and not mask.blank and mask.path not in levels:
            levels[mask.path] = _decode_mask(mask)
        allowed = None if mask is None else _mask_of(levels.get(mask.path), mask)
        made.append(LoadedImage(image, allowed))
    return made


def load_thumbnail(source: ImageSource, side: int) -> np.ndarray:
    """Decode an image to (4, h, w) uint8 RGBA, not premultiplied, with a longer side of ``side``.

    A JPEG file is decoded at a fraction of its size, which is several times faster. The pixels are
    close to those of `load_image`, but not equal. Smaller images are not enlarged.

    Raises: UserError: the file is missing, damaged, or not an image.
    """
    size = scaled_size(source.width, source.height, side)
    with open_photo(source.path) as opened:
        opened.draft("RGB", (2 * side, 2 * side))  # only JPEG; the size is at least this one
        planes = _planes(_turn_upright(eight_bits(opened, source.path), source), source.path)
    if source.view is None:
        pictures = map(Image.fromarray, planes)
        small = [np.asarray(plane.resize(size, Image.Resampling.BOX)) for plane in pictures]
    else:
        small = list(_resize_view(planes, source.view, *size))
    alpha = np.uint8(255) * covered_pixels(source.view, *size)
    return np.stack([*small[:3], np.minimum(small[3], alpha) if len(small) == 4 else alpha])


def load_mask(source: ImageSource) -> Tensor:
    """Decode a mask to (H, W) bool: True where its level is 128 or more, see `mask_levels`.

    Pixels of a view that the lens does not show are False.

    Raises: UserError: see `load_image`.
    """
    return _mask_of(None if source.blank else _decode_mask(source), source)


def box_downscale(image: LoadedImage, factor: int) -> LoadedImage:
    """Scale down with a box filter; the size is divided by ``factor`` and rounded down, minimum 1.

    A pixel of the mask is True if all pixels that it covers are True.
    """
    if factor == 1:
        return image
    height, width = image.planes.shape[1:]
    size = max(1, width // factor), max(1, height // factor)

    def reduced(planes: Tensor) -> Tensor:
        # PyTorch warns that its sums along a dimension may not be deterministic on a GPU.
        if planes.device.type == "cpu" or torch.are_deterministic_algorithms_enabled():
            return torch.from_numpy(resize_area(planes.cpu().numpy(), *size)).to(planes.device)
        return resize_area_on_gpu(planes, *size)

    mask = None if image.mask is None else reduced(image.mask[None].to(torch.uint8) * 255)
    return LoadedImage(reduced(image.planes), None if mask is None else mask[0] == 255)


def resize_area(planes: np.ndarray, width: int, height: int) -> np.ndarray:
    """Scale down (C, H, W) uint8 to (C, height, width): each pixel is the mean of its area.

    Areas are exact for any ratio, so intrinsics that are scaled by the ratio of each axis match
    the result exactly.
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


def resize_area_on_gpu(planes: Tensor, width: int, height: int) -> Tensor:
    """As `resize_area`, with the same values: each number is rounded in the same operations."""
    channels, old_height, old_width = planes.shape
    if (old_width, old_height) == (width, height):
        return planes
    rows, columns = old_height // height, old_width // width
    if (rows * height, columns * width) == (old_height, old_width):
        area = rows * columns
        sums = torch.full_like(planes[:, ::rows, ::columns], area // 2, dtype=torch.int64)
        for place in range(area):
            sums += planes[:, place // columns :: rows, place % columns :: columns]
        # Pillow divides by a product with 2²⁴ / area, rounded down.
        return (sums * ((1 << 24) // area) >> 24).to(torch.uint8)
    means = _mean_over_rows(planes.permute(2, 0, 1).reshape(old_width, -1), width)
    means = means.reshape(width, channels, old_height).permute(2, 1, 0).reshape(old_height, -1)
    resized = _mean_over_rows(means, height).round().to(torch.uint8)
    return resized.reshape(height, channels, width).transpose(0, 1).contiguous()


def _mean_over_rows(values: Tensor, count: int) -> Tensor:
    """(H, W) to (count, W) float64: means over equal intervals of each column."""
    size = len(values)
    edges = np.arange(count + 1) * (size / count)
    whole = np.minimum(edges.astype(np.int64), size - 1)
    part = torch.from_numpy(edges - whole).to(values.device)[:, None]
    at = torch.from_numpy(whole).to(values.device)
    means = []
    for band in values.split(max(1, _BAND_PIXELS // size), 1):
        band = band.to(torch.float64)
        # A GPU adds up along the first dimension from the first row to the last one.
        integral = pad(band.cumsum(0), (0, 0, 1, 0))
        at_edges = integral[at] + part * band[at]
        means.append(at_edges.diff(dim=0) * (count / size))
    return torch.cat(means, 1)


def _decode(source: ImageSource, background: Sequence[float] | None) -> np.ndarray:
    """The photo of a source as stored: planes of `load_image` before they are scaled."""
    with open_photo(source.path) as opened:
        planes = _planes(_turn_upright(eight_bits(opened, source.path), source), source.path)
    return _with_alpha(planes, background) if planes.shape[0] == 4 else planes


def _decode_mask(source: ImageSource) -> np.ndarray:
    """(H, W) uint8: the levels of a mask as stored."""
    with open_photo(source.path) as opened:
        return mask_levels(_turn_upright(opened, source))


def _mask_of(levels: np.ndarray | None, source: ImageSource) -> Tensor:
    """`load_mask` from levels as stored. None: the mask is white."""
    covered = torch.tensor(covered_pixels(source.view, source.width, source.height))
    if levels is None:
        return covered
    scaled = _resize_view(levels[None], source.view, source.width, source.height)[0]
    return torch.from_numpy(scaled >= 128) & covered


def _resize_view(planes: np.ndarray, view: LensView | None, width: int, height: int) -> np.ndarray:
    """(C, height, width) uint8: an image (C, H, W) uint8, or a view of it, scaled down. A view has
    several samples per pixel if the photo has more detail than the result."""
    if view is None:
        return resize_area(planes, width, height)
    ratio = view.width * planes.shape[2] / (view.lens.width * width)  # pixels of the photo, per one
    reduced = max(1, round(ratio / _SAMPLES))
    scale = planes.shape[2] / view.lens.width, planes.shape[1] / view.lens.height
    if reduced > 1:
        planes = np.stack([np.asarray(Image.fromarray(plane).reduce(reduced)) for plane in planes])
        scale = scale[0] / reduced, scale[1] / reduced
    samples = max(1, round(ratio / reduced))
    made = resample(planes, view, samples * width, samples * height, scale)
    if len(made) == 4:  # premultiplied colours
        made[:3] = np.minimum(made[:3], made[3])
    return resize_area(made, width, height)


def _mean_over_columns(values: np.ndarray, count: int) -> np.ndarray:
    """(H, W) to (H, count): means over equal intervals of each row, with fractional borders."""
    size = values.shape[1]
    edges = np.arange(count + 1) * (size / count)
    whole = np.minimum(edges.astype(np.int64), size - 1)
    part = edges - whole
    means: np.ndarray = np.empty((len(values), count))
    rows = max(1, _BAND_PIXELS // size)
    for top in range(0, len(values), rows):
        band = values[top : top + rows].astype(np.float64)
        # Each row is a step function. This is its integral from 0 to each pixel border.
        integral = np.zeros((len(band), size + 1))
        np.cumsum(band, axis=1, out=integral[:, 1:])
        at_edges = integral[:, whole] + part * band[:, whole]
        means[top : top + rows] = np.diff(at_edges, axis=1) * (count / size)
    return means


def _turn_upright(image: Image.Image, source: ImageSource) -> Image.Image:
    return ImageOps.exif_transpose(image) if source.apply_orientation else image


def _planes(image: Image.Image, path: Path) -> np.ndarray:
    """(3, H, W) or (4, H, W) uint8 sRGB, not premultiplied, of an image of 8 bits per channel."""
    transparent = is_transparent(image)
    mode = "RGBA" if transparent else "RGB"
    planes: np.ndarray = np.empty((len(mode), image.height, image.width), np.uint8)
    rows = max(1, _BAND_PIXELS // image.width)
    for top in range(0, image.height, rows):
        whole = rows >= image.height
        band = image if whole else image.crop((0, top, image.width, min(top + rows, image.height)))
        pixels = np.asarray(to_srgb(band, path))
        planes[:, top : top + rows] = pixels if pixels.ndim == 2 else pixels.transpose(2, 0, 1)
    if transparent and planes[3].min() == 255:
        return planes[:3].copy()
    return planes


def _with_alpha(planes: np.ndarray, background: Sequence[float] | None) -> np.ndarray:
    """Premultiplied RGBA (4, H, W), or RGB (3, H, W) over the background, from straight RGBA.
    Modifies ``planes``."""
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


@contextmanager
def open_photo(path: Path, *, header_only: bool = False) -> Iterator[Image.Image]:
    """An image file. Raises UserError if it cannot be read, here or in the block."""
    try:
        with open_image(path, PHOTO_FORMATS, header_only=header_only) as image:
            yield image
    except Exception as error:  # Pillow raises many kinds of exceptions for damaged files
        if not is_file(path):
            raise UserError("{path}: no such image", path=path) from None
        if isinstance(error, PermissionError):
            raise UserError("{path}: no permission to read it", path=path) from None
        raise UserError(
            "{path}: cannot be decoded ({reason_of}); replace the file or remove it",
            path=path,
            reason_of=reason_of(error),
        ) from None
