"""`plan_blocks`: cuts a dataset into blocks, and writes what the training of each block reads.

FOLDER/plan.json          the cells, and how all blocks are trained
FOLDER/block_01/dataset   an ordinary dataset: a COLMAP model, and links to the photos
FOLDER/block_01/scene     the output folder of its training
FOLDER/config.json …      FOLDER is also the output folder of the merged scene

A part of a dataset is written as a dataset of its own, with links to the photos.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from snowsplat._version import __version__
from snowsplat.data import read_files, read_undamaged
from snowsplat.data.colmap.model import write_posed
from snowsplat.data.dataset import Points, PosedImage
from snowsplat.data.lens.models import as_colmap, pinhole_of
from snowsplat.pipeline.blocks.content import Axes, Cell, block_content
from snowsplat.pipeline.options.benchmark import PlanOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.dataset_check import check_cameras
from snowsplat.pipeline.run.training_files import write_beginning
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.training_folder import DATASET, DatasetSettings, TrainingFolder
from snowsplat.scene.origin import HERE, Origin, opposite
from snowsplat.training.parts.found_sky import sky_distance
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import write_json
from snowsplat.util.run_lock import LOCK, one_run
from snowsplat.util.safe_json import from_json, read_json

logger = logging.getLogger(__name__)

PLAN = "plan.json"
# Pixels: a larger difference between a lens and its model in the files is reported.
_LENS_ERROR = 0.1


@dataclass(frozen=True)
class Block:
    """One block."""

    name: str  # "block_01", …; the name of its folder
    cell: Cell  # its part of the ground plane, of which the merged scene contains its Gaussians
    views: int  # number of training photos
    points: int  # number of points
    max_gaussians: int  # limit of the training, with those outside of the cell; 0: none


@dataclass(frozen=True)
class Plan:
    """The content of `plan.json`.

    Attributes:
        dataset: how the whole dataset is read.
        recipe: the recipe of all blocks.
        settings: changed settings of all blocks, see `TrainOptions`.
        axes: the axes of the ground plane.
        margin: the margin by which cells are expanded, as a share of their size.
        origin: that of the whole dataset; cells and the merged scene are relative to it.
        metres_per_unit: that of the whole dataset.
    """

    dataset: DatasetSettings
    recipe: str
    settings: dict[str, Any]
    axes: Axes
    margin: float
    blocks: list[Block]
    origin: Origin = HERE
    metres_per_unit: float | None = None

    @staticmethod
    def read(folder: Path) -> Plan:
        """The plan in a folder.

        Raises:
            UserError: there is none, it is unfinished, or it is damaged.
        """
        file = folder / PLAN
        if not file.is_file():
            raise UserError(
                "{folder}: contains no {plan}; run snowsplat blocks plan first",
                folder=folder,
                plan=PLAN,
            )
        try:
            content = read_json(file)
            content.pop("snowsplat")
            plan = from_json(Plan, content)
        except (ValueError, KeyError, AttributeError, TypeError):
            raise UserError(
                "{file}: damaged; run snowsplat blocks plan in a new folder", file=file
            ) from None
        if not plan.blocks:
            raise UserError(
                "{file}: the plan is unfinished; run snowsplat blocks plan again", file=file
            )
        return plan

    def write(self, folder: Path) -> None:
        write_json(folder / PLAN, {"snowsplat": __version__} | asdict(self))

    def ground(self, positions: Tensor) -> Tensor:
        """Positions (N, 3) relative to `origin` -> (N, 2) float64 in the ground plane."""
        axes = torch.tensor(self.axes, dtype=torch.float64)
        return positions.to(torch.float64) @ axes.T


def plan_blocks(
    dataset: Path | str, folder: Path | str, options: PlanOptions | None = None
) -> Plan:
    """Cut a dataset into blocks. See `block_content` for the photos and points of a block.

    Args:
        dataset: see `snowsplat.data.load_dataset`.
        folder: a new or an empty folder for the plan, the blocks and the merged scene.

    Logs a warning if the cameras are impossible or doubtful, see `check_cameras`.

    Raises:
        UserError: an unusable dataset or setting; more blocks than photos; ``folder`` contains a
            plan or other files.
        OSError: a file cannot be written.
    """
    options, folder = options or PlanOptions(), Path(folder)
    with one_run(folder):
        return _plan(dataset, folder, options)


def _plan(dataset: Path | str, folder: Path, options: PlanOptions) -> Plan:
    _check_free(folder)
    given: dict[str, Any] = {"exposure": "off", **options.settings}
    config = recipe(options.recipe, **given)
    if config.exposure != "off":
        raise SettingError("exposure", "would learn other gains in each block; use off")
    train_options = TrainOptions(
        images=options.images,
        resolution=options.resolution,
        hold_out=options.hold_out,
        test_list=options.test_list,
    )
    settings, files = read_undamaged(train_options.dataset_settings(dataset))
    whole = files.dataset(settings.resolution)
    check_cameras(whole, settings.path, trusted=True)
    if options.blocks > len(whole.train):
        raise SettingError(
            "blocks",
            "{blocks} is too large; there are {train} training photos",
            blocks=options.blocks,
            train=len(whole.train),
        )
    posed = [image for image, _ in files.images]
    if any(image.divided > 1 for image in posed):
        original = read_files(replace(settings, resolution=-1))
        posed += [image for image, _ in original.images]
    axes, contents = block_content(whole, options.blocks, options.margin)
    sizes = sorted(view.camera.width * view.camera.height for view in whole.train)
    config = config.capped(sizes[len(sizes) // 2], len(sizes))
    if config.sky and not config.sky_distance:  # so that the parts of the sky fit
        distance = sky_distance([view.camera for view in whole.train])
        given["sky_distance"] = float(f"{distance:.4g}")
    plan = Plan(
        settings,
        options.recipe,
        given,
        axes,
        options.margin,
        [],
        whole.origin,
        whole.metres_per_unit,
    )
    plan.write(folder)  # without blocks: it is unfinished
    limit, blocks, digits = config.density.max_gaussians, [], max(2, len(str(options.blocks)))
    for number, content in enumerate(contents, 1):
        name = f"block_{number:0{digits}d}"
        names = {view.name for view in content.views}
        own = [image for image in posed if image.name in names]
        write_block_dataset(folder / name / DATASET, own, content.points, whole.origin)
        own_limit = max(1, round(limit * content.share)) if limit else 0
        points = 0 if content.points is None else len(content.points)
        blocks.append(Block(name, content.cell, len(content.views), points, own_limit))
    write_beginning(TrainingFolder(folder), whole, settings, config)
    plan = replace(plan, blocks=blocks)
    plan.write(folder)
    return plan


def _check_free(folder: Path) -> None:
    """Raise `UserError` if ``folder`` contains anything but an unfinished plan."""
    if {entry.name for entry in folder.iterdir()} <= {LOCK}:
        return
    with suppress(OSError, ValueError, KeyError, TypeError):
        if read_json(folder / PLAN)["blocks"] == []:
            return
    what = "a plan" if (folder / PLAN).is_file() else "other files"
    raise UserError(
        "{folder}: already contains {what}; use a new folder, or remove it",
        folder=folder,
        what=what,
    )


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
        name = image.name + image.path.suffix * (not image.name.endswith(image.path.suffix))
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
