"""`Schedule`: the number of steps of a training run, and the steps of fractions of it."""

import math
from collections.abc import Collection
from dataclasses import dataclass

from snowsplat.util.settings import When


@dataclass
class Schedule:
    """The length of a training run. Trainer, optimiser and density control share this object.

    `stretch` makes a training run longer or shorter while it runs. It scales the rest of the
    schedule evenly and leaves the past unchanged: learning rates continue from their current
    values, no stage is repeated, and every stage is completed.

    Attributes:
        iterations: total number of steps.
        since: the step at which ``iterations`` was last changed.
        passed: the fraction of the schedule that was completed at step ``since``.
        batch: number of steps that are taken together, with one update; see ``TrainConfig.batch``.
    """

    iterations: int
    since: int = 0
    passed: float = 0.0
    batch: int = 1

    def update_of(self, step: int) -> int:
        """The number of updates up to ``step``."""
        return math.ceil(step / self.batch)

    def multiples(self, step: int, every: int) -> int:
        """How many multiples of ``every`` are among the steps of the batch that ends at ``step``.

        Without batches: 1 if ``step`` is a multiple, otherwise 0.
        """
        return step // every - self._before(step) // every

    def contains(self, step: int, moments: Collection[int]) -> bool:
        """Whether one of the moments is among the steps of the batch that ends at ``step``."""
        return any(self._before(step) < moment <= step for moment in moments)

    def _before(self, step: int) -> int:
        """The last step before the batch that ends at ``step``."""
        return self.batch * (self.update_of(step) - 1)

    def step_of(self, when: When) -> int:
        """The step of the moment ``when``; a past moment has a step in the past."""
        if not isinstance(when, float):
            return when
        if when < self.passed:
            return round(when / self.passed * self.since)
        ahead = self.iterations - self.since
        return self.since + round((when - self.passed) / (1.0 - self.passed) * ahead)

    def share(self, step: int, when: When = 1.0) -> float:
        """The completed fraction, 0 to 1, of the schedule up to ``when``, after ``step``."""
        if not isinstance(when, float):
            return min(1.0, step / max(1, when))
        start = min(1.0, self.passed / when) if when > 0.0 else 1.0
        steps = max(1, self.step_of(when) - self.since)
        return min(1.0, start + (1.0 - start) * ((step - self.since) / steps))

    def stretch(self, step: int, iterations: int) -> None:
        """Change the total number of steps to ``iterations``, after ``step``.

        Raises:
            ValueError: ``step`` is not before the old and the new end.
        """
        if step >= min(self.iterations, iterations):
            raise ValueError(
                f"cannot change to {iterations} steps: {step} of {self.iterations} are completed"
            )
        self.passed, self.since, self.iterations = self.share(step), step, iterations
