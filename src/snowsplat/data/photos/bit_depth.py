"""Converts pixels of 16 bits per channel to 8 bits, with one scale for all photos of a folder.

A file of 16 bits may have values of 10, 12 or 14 bits: cameras for machines store what their sensor
measures. The values of thermal cameras are far from 0, and close to each other. The scale follows
from all photos of the folder, because photos that are scaled one by one would not match.
"""

import logging
import sys
import threading
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from snowsplat.data.photos.image_file import open_image
from snowsplat.data.photos.tone_mapping import standard_range
from snowsplat.util.errors import Problem

logger = logging.getLogger(__name__)

# Formats with 16 bits per channel, by the extension of the file.
_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF", ".ppm": "PPM", ".pgm": "PPM"}
# How Pillow calls colours of 16 bits in a file: it reads one byte of each value. The last letter is
# the byte order. With the other order, it reads the lower byte.
_DEEP = ("RGB;16", "RGBA;16", "RGBX;16")
_OTHER_ORDER = {"L": "B", "B": "L", "N": "B" if sys.byteorder == "little" else "L"}
_BITS = (8, 10, 12, 14, 16)  # of the values of cameras
# So many photos of a folder are read, evenly spread: the number of bits is one of the camera.
_PHOTOS = 64
# Darker and brighter pixels, in %, are defects of the sensor or marks of invalid pixels.
_DEFECTS = 0.01

_lock = threading.Lock()


def eight_bits(image: Image.Image, path: Path) -> Image.Image:
    """The image with 8 bits per channel in standard range; the same object if it has no more.

    Args:
        image: opened, not decoded.
        path: its file.

    Raises:
        ValueError: floating-point pixels.
        Exception: anything that Pillow raises for a damaged file.
    """
    if image.mode == "F":
        raise Problem("floating-point pixels are not supported")
    if not _is_deep(image):
        return standard_range(image, path)
    scale = _scale_of(path)
    if not image.mode.startswith("I") and scale is None:
        return image  # Pillow reads the upper byte
    values = _values(image, path)
    pixels = (values >> 8).astype(np.uint8) if scale is None else scale[values]
    result = Image.fromarray(pixels)
    result.info = image.info
    return result


def _is_deep(image: Image.Image) -> bool:
    return image.mode.startswith("I") or _raw_mode(image).startswith(_DEEP)


def _raw_mode(image: Image.Image) -> str:
    """Pillow's name of the pixel format in the file; empty if the image is decoded already."""
    tiles = getattr(image, "tile", ())
    arguments = tiles[0][3] if tiles else ""
    first = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return first if isinstance(first, str) else ""


def _values(image: Image.Image, path: Path) -> NDArray[np.uint16]:
    """(H, W) or (H, W, C) uint16."""
    if image.mode.startswith("I"):
        return np.clip(np.asarray(image), 0, 65535).astype(np.uint16)
    raw = _raw_mode(image)
    swapped = raw[:-1] + _OTHER_ORDER[raw[-1]]
    upper = np.asarray(image, np.uint16)
    with open_image(path, tuple(_FORMATS.values()), page=image.tell()) as again:
        again.tile = [_with_raw_mode(tile, swapped) for tile in again.tile]
        return upper << 8 | np.asarray(again)


def _with_raw_mode(tile: Any, raw: str) -> Any:
    """A tile of an image that is not decoded yet, with another pixel format."""
    arguments = (raw, *tile[3][1:]) if isinstance(tile[3], tuple) else raw
    return tile._replace(args=arguments)


# The scale


def _scale_of(path: Path) -> NDArray[np.uint8] | None:
    """The level (65536,) of each value in the files of a folder; None: its upper byte."""
    folder = path.parent
    with _lock:  # several threads decode the photos of a folder
        return _scale(folder, path.suffix.lower(), folder.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _scale(folder: Path, suffix: str, changed: int) -> NDArray[np.uint8] | None:
    """As `_scale_of`, for the files with an extension.

    ``changed``: when a file was added; only to read the folder again.
    """
    low, high = 65535, 0
    for values in _deep_photos(folder, suffix):
        darkest, brightest = np.percentile(values, (_DEFECTS, 100 - _DEFECTS), method="nearest")
        low, high = min(low, int(darkest)), max(high, int(brightest))
        if high >> _BITS[-2] and low <= high - low:
            return None
    if low >= high:  # no such photos, or without any detail
        return None
    if low > high - low:  # in no light are the shadows of all photos so bright
        black, white = low, high
        logger.info(
            "%s: the photos have values from %s to %s of 16 bits; this range is shown from black "
            "to white, the same for all photos",
            folder,
            f"{low:,}",
            f"{high:,}",
        )
    else:
        bits = next(bits for bits in _BITS if high < 1 << bits)
        black, white = 0, (1 << bits) - 1
        logger.info(
            "%s: the photos use %d of 16 bits; all of them are scaled by %d, so that %s is white",
            folder,
            bits,
            1 << (_BITS[-1] - bits),
            f"{white:,}",
        )
    every = np.arange(1 << 16)
    return ((every - black) * 256 // (white - black + 1)).clip(0, 255).astype(np.uint8)


def _deep_photos(folder: Path, suffix: str) -> Iterator[NDArray[np.uint16]]:
    """The values of `_PHOTOS` files of 16 bits. Files that cannot be read are skipped."""
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() == suffix)
    for file in files[:: -(-len(files) // _PHOTOS)]:
        try:
            with open_image(file, tuple(_FORMATS.values())) as image:
                values = _values(image, file) if _is_deep(image) else None
        except Exception:  # Pillow raises many kinds of exceptions for damaged files
            continue
        if values is not None:
            yield values
