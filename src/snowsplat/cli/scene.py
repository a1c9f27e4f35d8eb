"""What `render` and `evaluate` share: the flags that name a scene and its views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import flag
from snowsplat.cli.making import SCENE
from snowsplat.cli.output import OutputFolder
from snowsplat.errors import UserError

if TYPE_CHECKING:
    from snowsplat.capture import Capture
    from snowsplat.gaussians import Gaussians


@dataclass
class SceneFlags:
    """Base of the verbs that take the output folder of a training."""

    output: Annotated[Path | None, tyro.conf.Positional, flag("OUT")] = None
    """Output folder of a training, ours or the reference implementation's."""
    model_path: Annotated[Path | None, flag("OUT", "-m", "-o")] = None
    """The reference's way to name it."""
    iteration: Annotated[int | None, flag("N", default="the last")] = None
    """Which of the scenes in OUT."""
    capture: Annotated[
        Path | None, flag("CAPTURE", "-s", "--source-path", default="as trained")
    ] = None
    """The photos and their cameras, if they are no longer where they were."""
    resolution: Annotated[int | None, flag("N", "-r", default="as trained")] = None
    """1, 2, 4 or 8 divide the size of the photos; any other number is a width."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Threads to compute with."""

    def folder(self) -> OutputFolder:
        """Raises: UserError: none named, or two."""
        if (self.output is None) == (self.model_path is None):
            raise UserError("name the output folder of a training, once")
        path = self.output or self.model_path or Path()
        if not path.is_dir():
            raise UserError(f"{path}: no such folder; give the output folder of a training")
        return training_folder(path)

    def load(self) -> tuple[int, Gaussians, Capture, tuple[float, float, float]]:
        """Iteration, scene, capture and background colour.

        Raises:
            UserError: one of them is absent or damaged.
        """
        capture, background = self.load_capture()
        iteration, gaussians = self.folder().read_scene(self.iteration)
        return iteration, gaussians, capture, background

    def load_capture(self) -> tuple[Capture, tuple[float, float, float]]:
        """Capture and background colour; sets the number of threads.

        Raises:
            UserError: there is none, or it is damaged.
        """
        settings, background = self.folder().settings()
        if self.capture is not None:
            settings = replace(settings, path=str(self.capture))
        if self.resolution is not None:
            settings = replace(settings, resolution=self.resolution)
        self.use_threads()
        return settings.load(), background

    def use_threads(self) -> None:
        """Raises: UserError: none at all."""
        if self.threads is not None:
            from snowsplat import ops

            if self.threads < 1:
                raise UserError(f"--threads is {self.threads}; it must be at least 1")
            ops.set_num_threads(self.threads)


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
