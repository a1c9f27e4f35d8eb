"""Masks of photos: black or transparent pixels are ignored by SfM and training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from snowsplat.data.image_file import reason_of
from snowsplat.sfm.ingest.photo_files import Header, open_image, turned
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown


def read_mask(path: Path, photo: Header, size: tuple[int, int]) -> np.ndarray:
    """The mask (H, W) bool, True for used pixels; upright, at the ``size`` of the copied photo.

    The mask file may be upright (by its pixels or by its own EXIF orientation), or have the
    orientation of the stored pixels of the photo. If the size does not distinguish these cases
    (photos rotated by 180°, square photos), the mask is not rotated. A pixel of a smaller copy is
    used if all pixels that it covers are used.

    Raises:
        UserError: the mask cannot be decoded, or its size is not that of the photo.
    """
    try:
        with open_image(path) as opened:
            noted = opened.getexif().get(0x0112, 1) != 1
            image = ImageOps.exif_transpose(opened).convert("RGBA")
    except Exception as error:  # Pillow's parsers raise anything on damaged files
        raise UserError(
            f"{shown(path)}: the mask cannot be decoded ({reason_of(error)}); replace or remove it"
        ) from None
    stored, upright = (photo.width, photo.height), photo.size(None)
    if not noted and image.size == stored:
        image = turned(image, photo.exif.orientation)
    elif image.size != upright:
        raise UserError(
            f"{shown(path)}: the mask is {image.width}x{image.height}, but its photo is "
            f"{upright[0]}x{upright[1]}; make a mask of this size"
        )
    pixels = np.asarray(image)
    counts = (pixels[..., :3].max(axis=2) >= 128) & (pixels[..., 3] >= 128)
    return shrunk(counts, size)


def shrunk(counts: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool resized to ``size`` (width, height): True if all covered pixels are True."""
    if counts.shape == size[::-1]:
        return counts
    image = Image.fromarray(counts.astype(np.uint8) * 255)
    return np.asarray(image.resize(size, Image.Resampling.BOX)) == 255


def write_mask(path: Path, counts: np.ndarray) -> None:
    """Write an 8-bit grey PNG, 0 or 255. Raises OSError if the disk is full."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(counts.astype(np.uint8) * 255).save(path, "PNG", compress_level=3)
