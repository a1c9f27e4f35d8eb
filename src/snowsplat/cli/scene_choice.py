"""`SceneChoice`: the flags of the subcommands whose input is the output folder of a training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.errors import UserError
from snowsplat.util.settings import Settings, argument, group, setting

if TYPE_CHECKING:
    from snowsplat.pipeline.output.scene_source import TrainedScene


@dataclass(frozen=True)
class SceneChoice(Settings):
    """A scene with its dataset, and the device for it."""

    output: Path | None = argument(
        None,
        "OUT",
        "Output folder of snowsplat train or make, or of the reference implementation. With "
        "--dataset, it may be a scene file of any program, in the world of that dataset.",
    )
    model_path: Path | None = setting(
        None,
        "The same as OUT. This is the flag of the reference implementation.",
        metavar="OUT",
        aliases=("-m", "-o"),
    )
    iteration: int | None = common.iteration()
    dataset: Path | None = common.dataset("--source-path")
    resolution: int | None = common.resolution("as trained")
    compute: Compute = group(Compute, only=("device", "threads"))

    def path(self) -> Path:
        """The output folder. Raises: UserError: none named, or two."""
        if (self.output is None) == (self.model_path is None):
            raise UserError("use exactly one output folder of a training run")
        return self.output or self.model_path or Path()

    def load(self) -> TrainedScene:
        """The scene with its dataset. Raises: UserError: one of them is missing or damaged."""
        from snowsplat.pipeline.output.scene_source import load_trained

        return load_trained(
            self.path(),
            iteration=self.iteration,
            dataset=self.dataset,
            resolution=self.resolution,
            compute=self.compute,
        )
