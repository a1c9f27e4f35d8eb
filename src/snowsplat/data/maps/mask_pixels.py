"""Masks: which pixels of the photo are used, and whether that is nearly nothing, or the wrong side.

Programs do not agree whether black or white marks what to ignore. Here it is black.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.data.photos.colour_profile import is_transparent
from snowsplat.data.photos.image_file import open_image
from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import Message, message

# The share of a typical photo below which hardly anything is used.
_LITTLE = 0.05
# Photographers aim at their subject. Masks that keep a border of nearly all photos completely and
# ignore their middle keep what is around the subject.
_FEWEST_MASKS = 5
_MOST_PHOTOS = 0.8
_IGNORED, _KEPT = 0.1, 0.98
# Masks are placed where something is to see, and so are the points of a model. In what masks keep
# there are not far fewer points than elsewhere.
_FEWER_POINTS = 0.25
# Mask files that are decoded to judge all.
_SAMPLE = 16
#: What to do about masks that are the wrong way round.
INVERT = message(
    "black pixels of a mask are ignored: if black marks what to keep, invert the masks"
)


@dataclass(frozen=True)
class MaskLook:
    """Shares of the pixels that a mask keeps, from 0 to 1."""

    kept: float  # of all pixels
    middle: float  # of those in the middle, a third of the width and of the height
    border: float  # of those in the rim, a sixteenth of the width and of the height


def look_of(used: np.ndarray) -> MaskLook:
    """The look of a mask (H, W) bool, True for pixels that are used."""
    height, width = used.shape
    middle = used[height // 3 : -(-2 * height // 3), width // 3 : -(-2 * width // 3)]
    y, x = -(-height // 16), -(-width // 16)
    rim = np.concatenate(
        [part.ravel() for part in (used[:y], used[-y:], used[:, :x], used[:, -x:])]
    )
    return MaskLook(*(round(float(part.mean()), 4) for part in (used, middle, rim)))


def doubt_about_masks(
    looks: Sequence[MaskLook], points_kept: float | None = None
) -> Message | None:
    """What is doubtful about masks, in one sentence; None if nothing is.

    Args:
        looks: of all masks of a dataset, or of a sample.
        points_kept: the share of the points in the photos that lie on pixels that masks keep; None
            if it is not known.
    """
    if not looks:
        return None
    kept = float(np.median([look.kept for look in looks]))
    if kept < _LITTLE:
        return message(
            "the masks ignore {share} of a typical photo; {invert}",
            share=_percent(1 - kept),
            invert=INVERT,
        )
    if points_kept is not None and points_kept < _FEWER_POINTS * kept:
        return message(
            "the masks keep {share} of a typical photo, but only {points} of the points of the "
            "model are there; {invert}",
            share=_percent(kept),
            points=_percent(points_kept),
            invert=INVERT,
        )
    around = sum(look.middle <= _IGNORED and look.border >= _KEPT for look in looks)
    if len(looks) >= _FEWEST_MASKS and around >= _MOST_PHOTOS * len(looks):
        return message(
            "the masks keep the border of most photos and ignore their middle; {invert}",
            invert=INVERT,
        )
    return None


def doubt_about_files(masks: Sequence[Path]) -> Message | None:
    """What is doubtful about mask files, by a sample; files that cannot be read are left out."""
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(len(masks), _SAMPLE)).astype(int))
    looks = []
    for path in (masks[i] for i in chosen):
        with suppress(Exception), open_image(path, MASK_FORMATS) as image:
            looks.append(look_of(mask_levels(image) >= 128))
    return doubt_about_masks(looks)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%" if 0.01 <= share <= 0.99 else f"{100 * share:.2g}%"


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
