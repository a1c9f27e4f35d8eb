"""Reads and writes masks of photos. SfM and training ignore black and transparent mask pixels."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from snowsplat.data.maps.mask_pixels import has_shape, mask_levels
from snowsplat.data.photos.image_file import reason_of
from snowsplat.sfm.ingest.photos.photo_files import Header, open_image, turn_upright
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown


def read_mask(path: Path, photo: Header, size: tuple[int, int]) -> np.ndarray:
    """The mask (H, W) bool, True for used pixels: upright, with the size of the copied photo.

    The mask file may be upright (by its pixels or by its own EXIF orientation), or have the
    orientation of the stored pixels of the photo. If both cases have the same size (photos rotated
    by 180°, square photos), the mask is rotated as the photo, unless it has an EXIF orientation
    itself.

    Args:
        photo: the header of the original photo.
        size: width and height of the copied photo. A mask of another size is scaled. If it is
            larger, a pixel of the result is used if all pixels that it covers are used.

    Raises: UserError: the mask cannot be decoded, or its aspect ratio is not that of the photo.
    """
    try:
        with open_image(path) as opened:
            has_orientation = opened.getexif().get(Base.Orientation, 1) != 1
            image = ImageOps.exif_transpose(opened)
            image.load()
    except Exception as error:  # Pillow may raise any exception for a damaged file
        raise UserError(
            "{path}: the mask cannot be decoded ({reason_of}); replace or remove it",
            path=shown(path),
            reason_of=reason_of(error),
        ) from None
    stored, upright = (photo.width, photo.height), photo.size(None)
    if not has_orientation and has_shape(image.size, stored):
        image = turn_upright(image, photo.exif.orientation)
    elif not has_shape(image.size, upright):
        raise UserError(
            "{path}: the mask is {width}x{height}, but its photo is {upright}x{upright2}; make a "
            "mask of this shape",
            path=shown(path),
            width=image.width,
            height=image.height,
            upright=upright[0],
            upright2=upright[1],
        )
    return shrink_mask(mask_levels(image) >= 128, size)


def shrink_mask(used: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool resized to ``size`` (width, height): True if all covered pixels are True."""
    if used.shape == size[::-1]:
        return used
    image = Image.fromarray(used.astype(np.uint8) * 255)
    return np.asarray(image.resize(size, Image.Resampling.BOX)) == 255


def write_mask(path: Path, used: np.ndarray) -> None:
    """Write an 8-bit grey PNG, 0 or 255. Raises OSError if the disk is full."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(used.astype(np.uint8) * 255).save(path, "PNG", compress_level=3)
