"""Gives the images of a dataset their masks, and says which masks are not used."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Sequence
from pathlib import Path

from snowsplat.data.dataset import PosedImage
from snowsplat.data.decode import IMAGE_SUFFIXES
from snowsplat.data.files.masks import find_masks

logger = logging.getLogger(__name__)


def with_masks(root: Path, posed: Sequence[PosedImage]) -> list[PosedImage]:
    """The images, with the masks that `find_masks` finds for those that have none.

    Logs a line if there are masks of no image in the folders of the images.

    Args:
        root: the folder of the dataset.
    """
    posed = list(posed)
    for base in dict.fromkeys(_base(root, image) for image in posed):
        here = [image for image in posed if _base(root, image) == base]
        names = {image.path.relative_to(base).as_posix(): image for image in here}
        folders = {name.rpartition("/")[0] for name in names}
        try:
            # All photos of these folders: a mask of a photo without a pose is not misspelt.
            beside = [f"{f}/{name}".lstrip("/") for f in folders for name in _images_in(base / f)]
            found = find_masks(base, sorted({*names, *beside}))
        except OSError:  # a folder that may not be read
            continue
        masks = {names[name]: mask for name, mask in found.of.items() if name in names}
        posed = [
            dataclasses.replace(image, mask=masks[image])
            if image.mask is None and image in masks
            else image
            for image in posed
        ]
        named = {image.mask.resolve() for image in posed if image.mask is not None}
        unused = [mask for mask in found.unused if mask.resolve() not in named]
        if unused:
            logger.warning(
                "%s: %d masks are not used, because no photo has the name of %s; the mask of "
                "IMG.jpg is masks/IMG.png, IMG.jpg.png or IMG_mask.png",
                *(root, len(unused), unused[0]),
            )
    return posed


def _base(root: Path, image: PosedImage) -> Path:
    return root if image.folder.is_relative_to(root) else image.folder


def _images_in(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return [
            entry.name
            for entry in entries
            if not entry.name.startswith(".")
            and os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES
        ]
