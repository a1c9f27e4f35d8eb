"""What a training writes: cameras and Gaussians in its `TrainingFolder`, and in checkpoints the
data that are not tensors: settings, recipe, time.

The refined cameras of a training run: a COLMAP model in its output folder.

OUT/refined/sparse/0 has the cameras of all photos, at their full size, and the points of the
dataset, in the world frame of its files. `load_dataset_of` uses it, and so can other programs and
further training runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.data import Dataset, View
from snowsplat.data.colmap.model import posed_camera, read_model, write_posed
from snowsplat.data.lens.models import pinhole_of
from snowsplat.data.points_ply import write_points
from snowsplat.formats import write_gaussians
from snowsplat.formats.origin_file import Place, written_with_place
from snowsplat.pipeline.run.dataset_check import Stamp
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene import camera_json
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.origin import opposite
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.settings.stored import config_to_json
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json

if TYPE_CHECKING:
    from snowsplat.training.core.checkpoint import Checkpoint


def write_beginning(
    folder: TrainingFolder, dataset: Dataset, settings: DatasetSettings, config: TrainConfig
) -> None:
    """Write the files that are known before the first step: settings, cameras, points."""
    folder.write_settings(settings, config_to_json(config))
    if dataset.points is not None:
        points = dataset.points
        write_points(folder.points, points.xyz.numpy(), points.rgb.numpy())
    with written_with_place(folder.cameras, Place(dataset.origin, dataset.metres_per_unit)):
        write_cameras(folder, [*dataset.train, *dataset.test])


def write_cameras(folder: TrainingFolder, views: Sequence[View]) -> None:
    """Write `cameras.json`."""
    # Several views of one photo are named by the photo and the view.
    cameras = (
        (view.name if part and part.name else Path(view.name).stem, view.camera)
        for view in views
        for part in [view.image.view]
    )
    camera_json.write_cameras(folder.cameras, cameras)


def write_scene(folder: TrainingFolder, iteration: int, gaussians: Gaussians) -> Path:
    """Save the scene; returns the file."""
    path = folder.scene_path(iteration)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_gaussians(path, gaussians)
    return path


@dataclass(frozen=True)
class CheckpointMeta:
    """The JSON object in a checkpoint; its keys are the names of the fields."""

    dataset: DatasetSettings  # how the dataset was read
    recipe: str  # the recipe from which the configuration was derived
    training: dict[str, Any]  # the configuration, see `config_to_json`
    time: dict[str, float] | None = None  # see `TimeBudget.as_json`; None without a time budget
    # The schedule, if it has changed: for a time budget.
    schedule: Schedule | None = None
    # Stamps of the photos and masks; None in checkpoints of earlier versions.
    photos: dict[str, Stamp] | None = None

    @classmethod
    def from_checkpoint(cls, start: Checkpoint) -> CheckpointMeta:
        """The checked data of the checkpoint ``start``, from which a training run resumes.

        Raises: UserError: not a checkpoint of a training run, or damaged.
        """
        try:
            meta = from_json(CheckpointMeta, dict(start.meta))
            if meta.time is not None and meta.time.keys() != {"seconds", "spent"}:
                raise ValueError("invalid time budget")
        except ValueError as error:
            raise UserError(
                "{path}: not a checkpoint of a training run ({error})", path=start.path, error=error
            ) from None
        return meta

    def as_json(self) -> dict[str, Any]:
        """The JSON value; fields that are None are left out."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def write_refined(output: TrainingFolder, views: Iterable[View], full: Dataset) -> Path:
    """Write the model of ``views``, which may have any size; returns its folder.

    ``full``: the same dataset, with the photos at their full size.
    """
    sizes = {v.name: (v.camera.width, v.camera.height) for v in [*full.train, *full.test]}
    posed = []
    for view in views:
        camera = view.camera.scaled(*sizes[view.name]).seen_from(opposite(full.origin))
        posed.append((view.name, pinhole_of(camera), camera.cam_from_world))
    folder, points = output.refined_model, full.points
    if points is None:
        write_posed(folder, posed)
    else:
        xyz = points.xyz.double().numpy() + full.origin
        write_posed(folder, posed, xyz, points.rgb.numpy())
    return folder


def with_refined(output: TrainingFolder, dataset: Dataset) -> Dataset:
    """The dataset with the cameras of `write_refined`; unchanged if there are none.

    Raises: UserError: the model is damaged, or a photo is not in it.
    """
    folder = output.refined_model
    if not folder.is_dir():
        return dataset
    model = read_model(folder)
    images = {image.name: image for image in model.images}

    def refined(view: View) -> View:
        if view.name not in images:
            raise UserError(
                "{folder}: has no camera for {name}; use the dataset of the training, or remove "
                "{refined} to use the cameras of the dataset",
                folder=folder,
                name=view.name,
                refined=output.refined,
            )
        camera = posed_camera(model, images[view.name]).seen_from(dataset.origin)
        camera = camera.scaled(view.camera.width, view.camera.height)
        return replace(view, camera=replace(camera, near=view.camera.near))

    return replace(
        dataset,
        train=[refined(view) for view in dataset.train],
        test=[refined(view) for view in dataset.test],
    )
