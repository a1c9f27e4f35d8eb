"""`Schedule`: the number of steps of a training run, and the steps of fractions of it."""

from __future__ import annotations

from dataclasses import dataclass

#: A moment of the training: a step (int), or a fraction of all steps (float).
When = int | float


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
    """

    iterations: int
    since: int = 0
    passed: float = 0.0

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
