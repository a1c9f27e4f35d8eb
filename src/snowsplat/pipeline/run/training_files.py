"""Writes the cameras and Gaussians of a training to its `TrainingFolder`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from snowsplat.data import Dataset, View
from snowsplat.data.points_ply import write_points
from snowsplat.formats import write_gaussians
from snowsplat.formats.origin_file import Place, write_place
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene import camera_json
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.stored import config_to_json


def write_beginning(
    folder: TrainingFolder, dataset: Dataset, settings: DatasetSettings, config: TrainConfig
) -> None:
    """Write the files that are known before the first step: settings, cameras, points."""
    folder.write_settings(settings, config_to_json(config))
    if dataset.points is not None:
        points = dataset.points
        write_points(folder.points, points.xyz.numpy(), points.rgb.numpy())
    write_cameras(folder, [*dataset.train, *dataset.test])
    write_place(folder.cameras, Place(dataset.origin, dataset.metres_per_unit))


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
