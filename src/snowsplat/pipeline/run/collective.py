"""`Collective`: the operations of a training that all its processes carry out together.

Process 0 calls the methods. Before each operation, it tells the other processes, which are in
`follow`, to do the same. A single process has nobody to tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from snowsplat.evaluation.metrics import Evaluation
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.trainer import Trainer


@dataclass(frozen=True)
class Collective:
    """The operations of one trainer; each process has its own."""

    trainer: Trainer

    def scene(self) -> Gaussians:
        """The Gaussians of all processes; the others than process 0 get no rows."""
        self._tell("scene")
        return self.trainer.shards.collect(self.trainer.gaussians)

    def state(self) -> dict[str, Tensor]:
        """See `Trainer.state_tensors`."""
        self._tell("state")
        return self.trainer.state_tensors()

    def evaluate(self) -> Evaluation:
        """See `Trainer.evaluate`."""
        self._tell("evaluate")
        return self.trainer.evaluate()

    def stretch(self, step: int, iterations: int) -> None:
        """See `Schedule.stretch`."""
        self._tell("stretch", step, iterations)
        self.trainer.schedule.stretch(step, iterations)

    def proceed(self) -> None:
        """Let the other processes go on with the next step, or end."""
        self.trainer.shards.of_first(None)

    def follow(self) -> None:
        """Do what process 0 does, until it calls `proceed`; for the other processes."""
        while (told := self.trainer.shards.of_first(None)) is not None:
            name, *arguments = told
            getattr(self, name)(*arguments)

    def _tell(self, *operation: Any) -> None:
        if self.trainer.shards.rank == 0:
            self.trainer.shards.of_first(operation)
