"""Masks: which pixels of a photo do not count. Black or transparent: left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from snowsplat.data.image_file import reason_of
from snowsplat.sfm.ingest.photo_files import Header, open_image, turned
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown


def read_mask(path: Path, photo: Header, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, True where the photo counts, upright and of ``size``, the photo's in ``input/``.

    The mask may be upright, by itself or by its own note of orientation, or lie as the photo's
    pixels are stored; where the sizes do not tell (turned by 180°, square), it is taken as stored.
    A pixel of a smaller copy counts where all that it covers does.

    Raises:
        UserError: it cannot be decoded, or is not as large as the photo.
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
        image = turned(image, photo.notes.orientation)
    elif image.size != upright:
        raise UserError(
            f"{shown(path)}: the mask is {image.width}x{image.height}, but its photo is "
            f"{upright[0]}x{upright[1]}; make it as large"
        )
    pixels = np.asarray(image)
    counts = (pixels[..., :3].max(axis=2) >= 128) & (pixels[..., 3] >= 128)
    return shrunk(counts, size)


def shrunk(counts: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool to ``size`` (width, height): True where all that a pixel covers is."""
    if counts.shape == size[::-1]:
        return counts
    image = Image.fromarray(counts.astype(np.uint8) * 255)
    return np.asarray(image.resize(size, Image.Resampling.BOX)) == 255


def write_mask(path: Path, counts: np.ndarray) -> None:
    """8-bit grey PNG, 0 or 255. Raises OSError: the disk is full."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(counts.astype(np.uint8) * 255).save(path, "PNG", compress_level=3)
