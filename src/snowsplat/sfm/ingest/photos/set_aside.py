"""Sets aside what is fixed to the frame: bars are cut off, everything else is masked.

See `fixed_parts` for what this is and how it is found. Photos are compared with those of the same
camera and size, frames with those of the same video.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from snowsplat.data.photos.colour_profile import plain_pixels
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.ingest.content.fixed_parts import (
    ENOUGH_PHOTOS,
    FIXED_SIDE,
    MIN_PHOTOS,
    FixedParts,
    box_of,
    describe,
    find_fixed_parts,
)
from snowsplat.sfm.ingest.content.sharpness import grey_copy
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.ingest.photos.mask_files import write_mask
from snowsplat.sfm.ingest.photos.photo_files import open_image, save
from snowsplat.util.messages import Message, message

_CROPPED = (".jpg", ".jpeg", ".png")  # formats in which a cropped photo can be saved


def set_fixed_parts_aside(
    photos: Sequence[Photo], dataset: Path, in_place: bool
) -> tuple[list[Photo], list[Message]]:
    """Crop and mask the photos of a dataset whose frames have fixed parts.

    Photos with transparency are left as they are: their background was removed already.

    Args:
        photos: the photos in ``input/``.
        in_place: ``input/`` contains the originals, which are not changed: bars are masked.

    Returns:
        The photos, in the same order, and a line for the user about each group with fixed parts.

    Raises: OSError: a file cannot be read or written.
    """
    folder = DatasetFolder(dataset)
    groups: dict[tuple[object, ...], list[Photo]] = {}
    for photo in photos:
        key = (photo.group, photo.width, photo.height, photo.sequence)
        groups.setdefault(key, []).append(photo)
    changed, lines = {}, []
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for group in groups.values():
            if len(group) < MIN_PHOTOS or any(photo.alpha for photo in group):
                continue
            count = min(len(group), ENOUGH_PHOTOS)
            chosen = [group[round(i * (len(group) - 1) / (count - 1))] for i in range(count)]
            copies = list(pool.map(lambda photo: _copy(folder.photos / photo.name), chosen))
            parts = find_fixed_parts(np.stack(copies))
            if parts is None:
                continue
            whole = in_place or group[0].panorama  # never cropped
            crops = not whole and all(p.name.lower().endswith(_CROPPED) for p in group)
            crop = parts.crop if crops else None
            size = group[0].width, group[0].height
            box = (0, 0, *size) if crop is None else box_of(crop, *size)

            def work(
                photo: Photo,
                parts: FixedParts = parts,
                cropped: bool = crop is not None,
                box: tuple[int, int, int, int] = box,
            ) -> Photo:
                fixed = parts.overlays if cropped else parts.fixed
                if parts.backdrop is not None:
                    fixed = parts.backdrop.seen_in(_copy(folder.photos / photo.name))
                if parts.circle is not None:
                    radius = parts.circle * photo.width / fixed.shape[1]
                    photo = replace(photo, circle=radius)
                return _crop_and_mask(photo, folder, box, fixed)

            for photo in pool.map(work, group):
                changed[photo.name] = photo
            lines += describe(parts, crop is not None, message("all {n} photos", n=len(group)))
    return [changed.get(photo.name, photo) for photo in photos], lines


def _copy(path: Path) -> NDArray[np.uint8]:
    with open_image(path) as image:
        image.draft("L", (FIXED_SIDE, FIXED_SIDE))  # faster decoding of JPEG
        return grey_copy(image, FIXED_SIDE)


def _crop_and_mask(
    photo: Photo, folder: DatasetFolder, box: tuple[int, int, int, int], fixed: NDArray[np.bool_]
) -> Photo:
    """The photo, cropped to ``box``, with the pixels masked that are ``fixed`` in its copy."""
    path = folder.photos / photo.name
    size = box[2] - box[0], box[3] - box[1]
    if size != (photo.width, photo.height):
        # The file may be a link to the original, which must not be changed.
        new = path.with_name(f".{path.name}")
        with open_image(path) as image:
            cropped = plain_pixels(image, path).crop(box)
        save(cropped, new, path)
        os.replace(new, path)
    still = Image.fromarray(fixed).resize((photo.width, photo.height), Image.Resampling.NEAREST)
    used = ~np.asarray(still, bool)[box[1] : box[3], box[0] : box[2]]
    mask_path = folder.mask_of(photo.name)
    if photo.mask:
        with Image.open(mask_path) as mask:
            used &= np.asarray(mask.convert("L").crop(box)) > 0
    if photo.mask or not used.all():
        write_mask(mask_path, used)
    width, height = size
    return replace(photo, width=width, height=height, mask=photo.mask or not bool(used.all()))
