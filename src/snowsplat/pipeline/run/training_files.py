"""What a training writes: cameras and Gaussians in its `TrainingFolder`, and in checkpoints the
data that are not tensors: settings, recipe, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.data import Dataset, View
from snowsplat.data.points_ply import write_points
from snowsplat.formats import write_gaussians
from snowsplat.formats.origin_file import Place, written_with_place
from snowsplat.pipeline.run.dataset_check import Stamp
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene import camera_json
from snowsplat.scene.gaussians import Gaussians
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
