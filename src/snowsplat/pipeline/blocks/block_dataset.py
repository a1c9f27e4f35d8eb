"""Writes a part of a dataset as a dataset of its own, with links to the photos."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.dataset import Points, PosedImage
from snowsplat.data.lens.brown import as_colmap
from snowsplat.data.lens.models import pinhole_of
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.scene.origin import Origin, opposite

logger = logging.getLogger(__name__)

# Pixels: a larger difference between a lens and its model in the files is reported.
_LENS_ERROR = 0.1


def write_block_dataset(
    folder: Path, posed: Iterable[PosedImage], points: Points | None, origin: Origin
) -> None:
    """Write a COLMAP model of some views and points, and link their photos, masks and maps.

    The links are relative symbolic links; without the permission to create them, hard links; on
    another drive, copies. ``cp -rL`` or ``rsync -L`` copies the dataset to another computer.

    Args:
        folder: replaced if it exists.
        posed: the images in their original size and, optionally, the same ones from the folders
            ``images_2`` ….
        origin: that of poses and points; the model is in the world.

    Raises: OSError: a file cannot be written.
    """
    shutil.rmtree(folder, ignore_errors=True)
    written = []
    worst = 0.0
    for image in posed:
        name = _file_name(image)
        if image.divided > 1:
            _link(image.path, folder / f"images_{image.divided}" / name)
            continue
        camera, lens = image.camera, image.lens
        lens, error = as_colmap(pinhole_of(camera) if lens.is_pinhole else lens)
        worst = max(worst, error)
        pose = camera.seen_from(opposite(origin)).cam_from_world
        written.append((name, lens, pose))
        _link(image.path, DatasetFolder(folder).images / name)
        if image.mask is not None:
            _link(image.mask, DatasetFolder(folder).masks / f"{name}.png")
        # A COLMAP dataset cannot state a unit; without points, the maps would be misunderstood.
        if image.depth is not None and (image.depth_unit == 1.0 or points is not None):
            _link(image.depth, folder / "depths" / f"{name}{image.depth.suffix}")
        if image.normals is not None:
            _link(image.normals, folder / "normals" / f"{name}{image.normals.suffix}")
    if worst > _LENS_ERROR:
        logger.warning(
            "%s: the lens distortion has terms that COLMAP's models do not have: an error of up to "
            "%.1f pixels; train without blocks if that matters",
            folder,
            worst,
        )
    model = DatasetFolder(folder).model
    if points is None:
        write_posed(model, written)
    else:
        write_posed(model, written, points.xyz.double().numpy() + origin, points.rgb.numpy())


def _file_name(image: PosedImage) -> str:
    """The name of a photo in the model: the name of the view, with the suffix of its file."""
    suffix = image.path.suffix
    return image.name if image.name.endswith(suffix) else image.name + suffix


def _link(file: Path, link: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    file = file.resolve()
    with suppress(OSError, ValueError):  # ValueError: another drive of Windows
        os.symlink(os.path.relpath(file, link.parent.resolve()), link)
        return
    try:
        os.link(file, link)
    except OSError:
        shutil.copyfile(file, link)
