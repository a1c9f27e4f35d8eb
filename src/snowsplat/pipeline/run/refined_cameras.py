"""The refined cameras of a training run: a COLMAP model in its output folder.

OUT/refined/sparse/0 has the cameras of all photos, at their full size, and the points of the
dataset, in the world frame of its files. `load_dataset_of` uses it, and so can other programs and
further training runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from snowsplat.data import Dataset, View
from snowsplat.data.colmap.model import posed_camera, read_model, write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import lens_of
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.scene.origin import opposite
from snowsplat.util.errors import UserError


def write_refined(output: TrainingFolder, views: Iterable[View], full: Dataset) -> Path:
    """Write the model of ``views``, which may have any size; returns its folder.

    ``full``: the same dataset, with the photos at their full size.
    """
    sizes = {v.name: (v.camera.width, v.camera.height) for v in [*full.train, *full.test]}
    numbers: dict[Lens, int] = {}
    images = []
    for view in views:
        camera = view.camera.scaled(*sizes[view.name])
        params = camera.fx, camera.fy, camera.cx, camera.cy
        pinhole = lens_of("PINHOLE", camera.width, camera.height, params)
        number = numbers.setdefault(pinhole, len(numbers) + 1)
        pose = camera.seen_from(opposite(full.origin)).cam_from_world
        numbers_of_pose = (*quat_from_rotation(pose[:, :3]).tolist(), *pose[:, 3].tolist())
        images.append(ColmapImage(view.name, number, numbers_of_pose))
    xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if full.points is not None:
        xyz, rgb = full.points.xyz.double().numpy() + full.origin, full.points.rgb.numpy()
    folder = output.refined_model
    write_model(folder, {number: camera for camera, number in numbers.items()}, images, xyz, rgb)
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
