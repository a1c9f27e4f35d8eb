"""`TimeBudget`: the time that a training run may take, and the time that is left.

The flags of `train` use this module: torch is imported in the functions that need it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from snowsplat.util.duration import duration
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    import torch

    from snowsplat.data import Dataset
    from snowsplat.training.budgets.pace import Pace
    from snowsplat.training.budgets.time_plan import Plan
    from snowsplat.training.core.trainer import Trainer
    from snowsplat.training.settings.config import TrainConfig


@dataclass
class TimeBudget:
    """The time of one training run, from the start of the command to its end."""

    seconds: float  # total time, including earlier runs
    spent: float = 0.0  # seconds in earlier runs, up to the checkpoint
    # When this run started, by `time.monotonic`.
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def for_run(
        cls, minutes: float | None, before: dict[str, Any] | None, started: float
    ) -> TimeBudget | None:
        """The budget of a training run; None if no time was requested, now or in an earlier run.

        Args:
            minutes: the requested time; if a run is resumed, the time for the remaining steps.
            before: the value of `as_json` in the checkpoint that is resumed.
        """
        if minutes is not None:
            return cls(60.0 * minutes, 0.0, started)
        return None if before is None else cls(before["seconds"], before["spent"], started)

    @property
    def left(self) -> float:
        """The seconds that are left; negative if the time is over."""
        return self.seconds - self.spent - (time.monotonic() - self.started)

    def as_json(self) -> dict[str, float]:
        """The JSON value for a checkpoint."""
        return {"seconds": self.seconds, "spent": self.seconds - self.left}

    def plan(
        self, dataset: Dataset, config: TrainConfig, device: torch.device, **allowed: bool
    ) -> Plan:
        """Choose the number of steps, the photo size and the limit of the number of Gaussians for
        the time that is left, for ``dataset`` at full resolution. ``allowed``: see `make_plan`.

        The speed is measured with a separate, short training run. The `Trainer` of the real run
        cannot be used, because its resolution, limit and schedule depend on the plan.
        """
        from snowsplat.training.budgets.time_plan import make_plan, measure_time_ratio

        resize = allowed.get("resize", True)
        time_ratio = measure_time_ratio(dataset, config, device, resize=resize)
        return make_plan(dataset, config, self.left, time_ratio, **allowed)

    def described(self, plan: Plan) -> Message:
        """The plan in one line."""
        return message(
            "{time} on this machine: {plan}", time=duration(self.seconds), plan=plan.summary()
        )

    def pace(self, trainer: Trainer, time_ratio: float) -> Pace:
        """The pace that keeps the training within the time that is left."""
        from snowsplat.training.budgets.pace import Pace
        from snowsplat.training.budgets.step_cost import Work

        return Pace(Work.for_training(trainer.config, trainer.dataset), self.left, time_ratio)
