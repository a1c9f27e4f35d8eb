"""The real scene of the figures: that of `snowsplat demo`, trained with the recipe `default`.

The photos, the dataset and the trained scene are stored in build/learn, and made if they are
missing (some minutes). The dataset has all photos: the demo itself has a time limit, and uses fewer
of them on a slow machine.
"""

import functools
from pathlib import Path

import numpy as np
from torch import Tensor

from snowsplat import Camera, Gaussians, read_gaussians, write_gaussians
from snowsplat.data.dataset import Dataset
from snowsplat.data.load import load_dataset
from snowsplat.pipeline.observer import SILENT
from snowsplat.scene.render import render
from snowsplat.sfm.make_dataset import make_dataset
from snowsplat.sfm.options import DatasetOptions
from snowsplat.synthetic import write_synthetic_photos
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe

BUILD = Path(__file__).resolve().parents[3] / "build" / "learn"
VIEW = "IMG_0013.jpg"  # the photo that the figures show


@functools.cache
def dataset_folder() -> Path:
    """The dataset of the demo, with the database of structure from motion."""
    photos, folder = BUILD / "photos", BUILD / "dataset"
    write_synthetic_photos(photos)
    make_dataset([photos], folder, DatasetOptions(), SILENT)
    return folder


@functools.cache
def dataset() -> Dataset:
    """The photos with the poses that structure from motion has found; every 8th is held out."""
    return load_dataset(dataset_folder())


@functools.cache
def trained() -> Gaussians:
    path = BUILD / "scene.ply"
    if not path.exists():
        trainer = Trainer(dataset(), recipe("default"))
        trainer.run()
        write_gaussians(path, trainer.gaussians)
    return read_gaussians(path)


def camera(width: int = 480, name: str = VIEW) -> Camera:
    """The camera of a photo, for a rendering of this width in pixels."""
    (found,) = (v.camera for v in [*dataset().train, *dataset().test] if v.name == name)
    return found.scaled(width, round(width * found.height / found.width))


def pixels(image: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 of a rendering."""
    return np.rint(255 * image.detach().clamp(0, 1).numpy()).astype(np.uint8)


def rendering(gaussians: Gaussians, view: Camera) -> np.ndarray:
    """(H, W, 3) uint8: the scene from a camera."""
    return pixels(render(gaussians, view).image)


if __name__ == "__main__":
    print(len(trained()), "Gaussians")
