"""The sizes of the image files of a dataset, against those of their cameras."""

import logging
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from snowsplat.data.dataset import PosedImage
from snowsplat.data.files.photo_files import warn_of_unusable
from snowsplat.data.maps.mask_pixels import has_shape
from snowsplat.data.photos.decode import IMAGE_SUFFIXES, Header, read_header
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file

logger = logging.getLogger(__name__)

# The largest ratio between the size of a camera and the size of its image file.
_LARGEST_FACTOR = 16


@dataclass(frozen=True)
class ImageSize:
    """The size of an image file as it is used.

    Attributes:
        width, height: pixels, after the EXIF orientation if it is applied.
        oriented: apply the EXIF orientation.
        stored: number of pixels in the file.
    """

    width: int
    height: int
    oriented: bool
    stored: int


def with_smaller_copies(posed: list[PosedImage], divisor: int) -> list[PosedImage]:
    """The same images from the folder ``images_N``, N = ``divisor``.

    The images are returned unchanged if an image in this folder is missing or has another size.
    """
    smaller = []
    for image in posed:
        if not image.folder.name:
            return posed
        folder = image.folder.with_name(f"{image.folder.name}_{divisor}")
        stem = str(Path(image.file).with_suffix(""))
        names = (image.file, *(stem + s for s in IMAGE_SUFFIXES), stem + ".JPG", stem + ".PNG")
        found = next((name for name in names if is_file(folder / name)), None)
        if found is None or not _is_copy(image.path, folder / found, divisor):
            if folder.is_dir():
                logger.warning(
                    "%s: not used, because %s %s; the large images are scaled instead",
                    folder,
                    image.file,
                    "is missing" if found is None else f"is not 1/{divisor} of the large image",
                )
            return posed
        smaller.append(replace(image, folder=folder, file=found, divided=divisor))
    return smaller


def _is_copy(large: Path, small: Path, factor: int) -> bool:
    header = read_header(small)
    return _is_divided(read_header(large), (header.width, header.height), factor)


def _is_divided(large: Header | Camera, size: tuple[int, int], factor: float) -> bool:
    """Whether ``size`` is the size of ``large``, divided by ``factor``."""
    # Sizes that are not divisible are rounded up by some tools and down by others.
    return abs(size[0] - large.width / factor) < 1 and abs(size[1] - large.height / factor) < 1


def with_sizes(root: Path, posed: list[PosedImage]) -> list[tuple[PosedImage, ImageSize]]:
    """The images with the sizes of their files, checked against those of camera and mask.

    The images of a folder may be smaller or larger than the images that the poses were estimated
    from (for example ``images_4``, or a dataset that is distributed without the large images). The
    ratio of the sizes must be the same for all images of a folder. An image that is damaged, or
    has another size, is left out with a warning.

    Raises: UserError: at least half of the files are missing or no images, or do not have the sizes
        of their cameras.
    """
    errors: dict[str, UserError] = {}
    found: list[tuple[PosedImage, Header, float | None, bool]] = []
    for image in posed:
        try:
            header = read_header(image.path)
            found.append((image, header, *_shrink_factor(image, header)))
        except UserError as error:
            errors[image.name] = error
    factors: dict[Path, list[float]] = {}
    for image, _, factor, _ in found:
        if factor is not None:
            factors.setdefault(image.folder, []).append(factor)
    # The most frequent factor in each folder.
    usual = {path: Counter(sorted(each)).most_common(1)[0][0] for path, each in factors.items()}
    sized = []
    for image, header, factor, oriented in found:
        size = (header.height, header.width) if oriented else (header.width, header.height)
        used = ImageSize(*size, oriented, header.width * header.height)
        fits = factor is not None and _is_divided(image.camera, size, usual[image.folder])
        wrong = _wrong_mask(image, used) if fits else _other_size(image, header)
        if wrong is None:
            sized.append((image, used))
        else:
            errors[image.name] = wrong
    warn_of_unusable(root, errors, len(sized))
    for folder, factor in usual.items():
        if factor != 1 and not folder.name.endswith(f"_{factor:g}"):
            logger.warning(
                "%s: the images are %s of the size of their cameras; the cameras are scaled",
                folder,
                f"1/{factor:g}" if factor == round(factor) else f"{1 / factor:.4g}",
            )
    return sized


def _shrink_factor(image: PosedImage, header: Header) -> tuple[float | None, bool]:
    """The image size of the camera divided by that of the file; whether to apply EXIF orientation.

    The factor is None if the size of the file does not match the camera. Like COLMAP, this ignores
    the EXIF orientation, unless the image matches its camera only with the orientation applied.
    """
    camera = image.camera
    for sideways in (False, True) if header.sideways else (False,):
        width, height = (header.height, header.width) if sideways else (header.width, header.height)
        if (width, height) == (camera.width, camera.height):
            return 1.0, sideways
        ratio = max(camera.width, camera.height) / max(width, height)
        if not 1 < max(ratio, 1 / ratio) <= _LARGEST_FACTOR:
            continue
        for factor in (max(2, round(ratio)), ratio):
            if _is_divided(camera, (width, height), factor):
                return float(factor), sideways
    return None, False


def _other_size(image: PosedImage, header: Header) -> UserError:
    camera = image.camera
    return UserError(
        "{path}: is {width}x{height}, but its camera is {width2}x{height2}; use the images that "
        "the poses were estimated from, or scale all of them by one factor",
        path=image.path,
        width=header.width,
        height=header.height,
        width2=camera.width,
        height2=camera.height,
    )


def _wrong_mask(image: PosedImage, size: ImageSize) -> UserError | None:
    """Why the mask of an image cannot be used; it may be smaller than the image."""
    if image.mask is None:
        return None
    try:
        mask = read_header(image.mask)
    except UserError as error:
        return error
    own = (mask.width, mask.height)
    if size.oriented and mask.sideways:
        own = (mask.height, mask.width)
    # Sides are rounded to whole pixels of the mask, or of an image that is smaller.
    if has_shape(own, (size.width, size.height)):
        return None
    return UserError(
        "{path}: the mask is {own}x{own2}, but its image is {width}x{height}; use a mask of "
        "the whole image",
        path=image.mask,
        own=own[0],
        own2=own[1],
        width=size.width,
        height=size.height,
    )
