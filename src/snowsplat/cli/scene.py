"""What the verbs that take a scene share: the flags and paths that name it, and its cameras."""

from __future__ import annotations

import filecmp
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.computing import compute_with
from snowsplat.cli.flags import flag
from snowsplat.pipeline.output_folder import SCENE, OutputFolder
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import torch

    from snowsplat.data import Dataset
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians


@dataclass
class SceneFlags:
    """Base of the verbs that take the output folder of a training."""

    output: Annotated[Path | None, tyro.conf.Positional, flag("OUT")] = None
    """Output folder of a training, ours or the reference implementation's."""
    model_path: Annotated[Path | None, flag("OUT", "-m", "-o")] = None
    """The reference's way to name it."""
    iteration: Annotated[int | None, flag("N", default="the last")] = None
    """Which of the scenes in OUT."""
    dataset: Annotated[
        Path | None, flag("DATASET", "-s", "--source-path", "--capture", default="as trained")
    ] = None
    """The photos and their cameras, if they are no longer where they were."""
    resolution: Annotated[int | None, flag("N", "-r", default="as trained")] = None
    """1, 2, 4 or 8 divide the size of the photos; any other number is a width."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Threads to compute with, on the CPU."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """What to compute on."""

    def folder(self) -> OutputFolder:
        """Raises: UserError: none named, or two."""
        if (self.output is None) == (self.model_path is None):
            raise UserError("name the output folder of a training, once")
        path = self.output or self.model_path or Path()
        if not path.is_dir():
            raise UserError(f"{path}: no such folder; give the output folder of a training")
        return training_folder(path)

    def load(self) -> tuple[int, Gaussians, Dataset, tuple[float, float, float]]:
        """Iteration, scene, dataset and background colour.

        Raises:
            UserError: one of them is absent or damaged.
        """
        dataset, background = self.load_dataset()
        iteration, gaussians = self.folder().read_scene(self.iteration)
        return iteration, gaussians.to(self.computing()), dataset, background

    def load_dataset(self) -> tuple[Dataset, tuple[float, float, float]]:
        """Capture and background colour.

        Raises:
            UserError: there is none, or it is damaged.
        """
        settings, background = self.folder().settings()
        if self.dataset is not None:
            settings = replace(settings, path=str(self.dataset))
        if self.resolution is not None:
            settings = replace(settings, resolution=self.resolution)
        return settings.load(), background

    def computing(self) -> torch.device:
        """What to compute on; sets the number of threads.

        Raises:
            UserError: a device that cannot be used, or no threads at all.
        """
        return compute_with(self.threads, self.device)


def training_folder(path: Path) -> OutputFolder:
    """The output folder that ``path`` names: of `train`, or of `make`, which has that within."""
    folder, made = OutputFolder(path), OutputFolder(path / SCENE)
    return made if made.scenes() and not folder.scenes() else folder


def scene_file(path: Path) -> Path:
    """The scene that ``path`` names: itself, or the last one in the output folder of a training.

    Raises:
        UserError: no such file or folder, or a folder without a scene.
    """
    if not path.is_dir():
        return path
    folder = training_folder(path)
    scenes = folder.scenes()
    if not scenes:
        raise UserError(f"{path}: holds no scene (no point_cloud/iteration_N in it)")
    return folder.scene_path(scenes[-1])


def folder_around(scene: Path) -> OutputFolder:
    """The output folder of the training that a scene file comes from; if none, one without scenes.

    That is OUT of OUT/point_cloud/iteration_N/point_cloud.ply, and OUT/scene of OUT/NAME.ply, the
    copy that `snowsplat make` leaves.
    """
    scene = scene.resolve()
    made, trained = OutputFolder(scene.parent / SCENE), OutputFolder(scene.parent.parent.parent)
    if scene in map(trained.scene_path, trained.scenes()):
        return trained
    if any(filecmp.cmp(scene, made.scene_path(i), shallow=False) for i in made.scenes()[-1:]):
        return made
    return OutputFolder(scene)


def cameras_of(folder: OutputFolder) -> list[Camera]:
    """The cameras of the photos that the training in ``folder`` had; none if it does not tell.

    Raises:
        UserError: the list is damaged.
    """
    from snowsplat.scene.camera_json import read_cameras

    file = folder.path / "cameras.json"
    return read_cameras(file)[1] if file.is_file() else []
