"""The flags of the subcommands whose input is the output folder of a training run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import Threads, flag
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.pipeline.compute import Compute
    from snowsplat.pipeline.output.scene_source import TrainedScene


@dataclass
class SceneFlags:
    """The base class of these subcommands."""

    output: Annotated[Path | None, tyro.conf.Positional, flag("OUT")] = None
    """Output folder of snowsplat train or make, or of the reference implementation. With --dataset,
    it may be a scene file of any program, in the world of that dataset."""
    model_path: Annotated[Path | None, flag("OUT", "-m", "-o")] = None
    """The same as OUT. This is the flag of the reference implementation."""
    iteration: Annotated[int | None, flag("N", default="the last step")] = None
    """If OUT contains several scenes, the step after which the scene was saved."""
    dataset: Annotated[
        Path | None, flag("DATASET", "-s", "--source-path", "--capture", default="as trained")
    ] = None
    """Folder of the dataset, if it was moved after the training."""
    resolution: Annotated[int | None, flag("N", "-r", default="as trained")] = None
    """With 1, 2, 4 or 8, the width and height of the photos are divided by this number. Any other
    number is the new width in pixels."""
    threads: Threads = None
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to compute on."""

    def output_path(self) -> Path:
        """The output folder. Raises: UserError: none named, or two."""
        if (self.output is None) == (self.model_path is None):
            raise UserError("use exactly one output folder of a training run")
        return self.output or self.model_path or Path()

    def compute(self) -> Compute:
        """The device and threads. Raises: UserError: fewer than 1 thread."""
        from snowsplat.pipeline.compute import Compute

        return Compute(self.device, self.threads)

    def load(self) -> TrainedScene:
        """The scene with its dataset. Raises: UserError: one of them is missing or damaged."""
        from snowsplat.pipeline.output.scene_source import load_trained

        return load_trained(
            self.output_path(),
            iteration=self.iteration,
            dataset=self.dataset,
            resolution=self.resolution,
            compute=self.compute(),
        )
