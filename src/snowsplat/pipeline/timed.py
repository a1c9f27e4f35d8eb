"""A training with a time: how much of it is left, what is planned for it, how it is kept."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from snowsplat.cli.progress import duration
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import torch

    from snowsplat.data import Dataset
    from snowsplat.training.config import TrainConfig
    from snowsplat.training.time_budget.pace import Pace
    from snowsplat.training.time_budget.plan import Plan
    from snowsplat.training.trainer import Trainer


@dataclass
class TimeBudget:
    """The time of one training, from the start of the command to its end.

    Attributes:
        seconds: in all, those of the runs before included.
        spent: in the runs before, up to the checkpoint.
        started: when this run was, by `time.monotonic`.
    """

    seconds: float
    spent: float = 0.0
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def of(
        cls, minutes: float | None, before: dict[str, Any] | None, started: float
    ) -> TimeBudget | None:
        """
        Args:
            minutes: those that were asked for; for a training that goes on: for what is left of it.
            before: what `as_json` gave for the checkpoint from which it goes on.

        Returns:
            None where no time was ever asked for.

        Raises:
            UserError: no time at all.
        """
        if minutes is not None:
            if not 0.0 < 60.0 * minutes < float("inf"):
                raise UserError(f"--minutes is {minutes:g}; it must be more than 0")
            return cls(60.0 * minutes, 0.0, started)
        return None if before is None else cls(before["seconds"], before["spent"], started)

    @property
    def left(self) -> float:
        """Seconds."""
        return self.seconds - self.spent - (time.monotonic() - self.started)

    def as_json(self) -> dict[str, float]:
        """For a checkpoint."""
        return {"seconds": self.seconds, "spent": self.seconds - self.left}

    def plan(
        self, dataset: Dataset, config: TrainConfig, device: torch.device, **may: bool
    ) -> Plan:
        """What to train. ``capture`` is at full resolution; ``may``: see `make_plan`."""
        from snowsplat.training.time_budget.plan import make_plan, measure_slowness

        slowness = measure_slowness(dataset, config, device, resize=may.get("resize", True))
        return make_plan(dataset, config, self.left, slowness, **may)

    def described(self, plan: Plan) -> str:
        """The plan in one line."""
        return f"{duration(self.seconds)} on this machine: {plan}"

    def pace(self, trainer: Trainer, slowness: float) -> Pace:
        """What keeps the trainer to the time that is left."""
        from snowsplat.training.time_budget.pace import Pace
        from snowsplat.training.time_budget.step_cost import Work

        sizes = [view.camera.width * view.camera.height for view in trainer.dataset.train]
        work = Work(trainer.config, sum(sizes) / len(sizes), len(trainer.dataset.test))
        return Pace(work, self.left, slowness)
