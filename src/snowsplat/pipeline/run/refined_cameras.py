"""The refined cameras of a training run: a COLMAP model in its output folder.

OUT/refined/sparse/0 has the cameras of all photos, at their full size, and the points of the
dataset, in the world frame of its files. `load_dataset_of` uses it, and so can other programs and
further training runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from snowsplat.data import Dataset, View
from snowsplat.data.colmap.model import posed_camera, read_model, write_posed
from snowsplat.data.lens.models import pinhole_of
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.origin import opposite
from snowsplat.util.errors import UserError


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
