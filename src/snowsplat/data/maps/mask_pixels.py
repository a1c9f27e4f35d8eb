"""The pixels of a mask file, of any kind: which pixels of the photo are used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.data.photos.colour_profile import is_transparent
from snowsplat.data.photos.image_file import open_image, scaled_size

#: The formats of masks, by the names of Pillow.
MASK_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
# A mask is black and white, except for its edges and the noise of JPEG.
_DARK, _BRIGHT = 64, 192
_LEAST_BLACK_AND_WHITE = 0.9
# The longer side at which files are compared with the look of a mask.
_SMALL_SIDE = 256


def mask_levels(image: Image.Image) -> np.ndarray:
    """(H, W) uint8: a pixel of the photo is used if its level is 128 or more.

    The level is that of the brightest channel, times the opacity. If the image has transparent
    pixels and the rest of it is not black and white (a photo whose background was removed, or one
    colour), the level is the opacity. Masks of 0 and 1 are those of 0 and 255.
    """
    if image.mode == "F":
        values = np.nan_to_num(np.asarray(image))
        return ((values > 0.5 * max(float(values.max()), 1e-9)) * 255).astype(np.uint8)
    if image.mode.startswith("I"):  # 16 bits
        values = np.asarray(image).astype(np.int64)
        top = int(values.max())
        scale = 1 if top == 1 else 255 if top <= 255 else 65535
        return np.clip(values * 255 // scale, 0, 255).astype(np.uint8)
    if image.mode == "1":
        return np.asarray(image).astype(np.uint8) * 255
    if not is_transparent(image):
        brightest = _brightest(image)
        return brightest * 255 if brightest.max() == 1 else brightest
    pixels = image.convert("RGBA")
    alpha = np.asarray(pixels.getchannel("A"))
    brightest = _brightest(pixels.convert("RGB"))
    opaque = brightest[alpha >= 128]
    if alpha.min() < 255 and not _is_black_and_white(opaque):
        return alpha
    return (brightest.astype(np.uint16) * alpha // 255).astype(np.uint8)


def _brightest(image: Image.Image) -> np.ndarray:
    """(H, W) uint8: the brightest channel of each pixel."""
    if image.mode == "L":
        return np.asarray(image)
    red, green, blue = (np.asarray(plane) for plane in image.convert("RGB").split())
    return np.maximum(np.maximum(red, green), blue)


def _is_black_and_white(levels: np.ndarray) -> bool:
    """Whether there are both dark and bright pixels, and few others."""
    dark, bright = np.count_nonzero(levels < _DARK), np.count_nonzero(levels >= _BRIGHT)
    return bool(min(dark, bright) > 0 and dark + bright >= _LEAST_BLACK_AND_WHITE * levels.size)


def has_shape(mask: tuple[int, int], photo: tuple[int, int]) -> bool:
    """Whether a mask has the aspect ratio of a photo, up to the rounding of its sides.

    Args:
        mask, photo: width and height in pixels.
    """
    return abs(mask[0] * photo[1] - mask[1] * photo[0]) <= max(sum(mask), sum(photo))


def looks_like_mask(path: Path) -> bool:
    """Whether an image file has only black (or transparent) and white pixels, or one colour.

    A file that cannot be read does not.
    """
    try:
        with open_image(path, MASK_FORMATS) as opened:
            opened.draft("RGB", (_SMALL_SIDE, _SMALL_SIDE))
            size = scaled_size(opened.width, opened.height, _SMALL_SIDE)
            image = opened.resize(size, Image.Resampling.NEAREST)
            image.info = opened.info
            levels = mask_levels(image)
    except Exception:  # Pillow raises many kinds of exceptions for damaged files
        return False
    dark, bright = np.mean(levels < _DARK), np.mean(levels >= _BRIGHT)
    return bool(dark + bright >= _LEAST_BLACK_AND_WHITE) and _has_one_hue(image)


def _has_one_hue(image: Image.Image) -> bool:
    """Whether the bright pixels have the same colour, up to the noise of JPEG."""
    if image.mode in ("1", "L", "LA", "I", "I;16", "I;16B", "F"):
        return True
    pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(np.int16)
    bright = pixels[pixels.max(1) >= _BRIGHT]
    if not len(bright):
        return True
    near = np.abs(bright - np.median(bright, axis=0)).max(1) < _DARK
    return bool(near.mean() >= _LEAST_BLACK_AND_WHITE)
