"""Reads the dataset of a training, and writes its cameras and Gaussians to a `TrainingFolder`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from snowsplat.data import Dataset, DatasetFiles, View, read_files
from snowsplat.data.points_ply import write_points
from snowsplat.formats import write_gaussians
from snowsplat.formats.origin_file import Place, write_place
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene import camera_json
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.stored import config_to_json


def read_dataset(settings: DatasetSettings) -> Dataset:
    """The dataset. Raises: UserError: see `snowsplat.data.load_dataset`."""
    return read_dataset_files(settings).dataset(settings.resolution)


def read_dataset_files(settings: DatasetSettings) -> DatasetFiles:
    """The files of the dataset, to load it at several resolutions; see `read_dataset`."""
    return read_files(**asdict(settings))


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
