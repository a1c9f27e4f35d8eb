"""`Schedule`: how many steps a training has, and which of them is meant by "half-way through"."""

from __future__ import annotations

from dataclasses import dataclass

#: A moment of the training: an int is that step, a float that fraction of the whole.
When = int | float


@dataclass
class Schedule:
    """The length of one training; trainer, optimiser and density control share this object.

    ``stretch`` makes the training longer or shorter while it runs. What lies ahead is stretched
    evenly, what is past stays past: learning rates go on from where they are, no stage comes twice,
    and each still reaches its end.

    Attributes:
        iterations: steps in all.
        since: the step at which that was last changed.
        passed: the fraction of the whole that was over then.
    """

    iterations: int
    since: int = 0
    passed: float = 0.0

    def step_of(self, when: When) -> int:
        """The step that ``when`` means; of a moment that is over, some step that is over too."""
        if not isinstance(when, float):
            return when
        if when < self.passed:
            return round(when / self.passed * self.since)
        ahead = self.iterations - self.since
        return self.since + round((when - self.passed) / (1.0 - self.passed) * ahead)

    def share(self, step: int, when: When = 1.0) -> float:
        """How much of the way to ``when`` is over after ``step``, 0 to 1."""
        if not isinstance(when, float):
            return min(1.0, step / max(1, when))
        start = min(1.0, self.passed / when) if when > 0.0 else 1.0
        steps = max(1, self.step_of(when) - self.since)
        return min(1.0, start + (1.0 - start) * ((step - self.since) / steps))

    def stretch(self, step: int, iterations: int) -> None:
        """Change the number of steps in all to ``iterations``, where ``step`` was the last one."""
        if not step < self.iterations or not step < iterations:
            raise ValueError(f"{iterations} steps, but {step} of {self.iterations} are done")
        self.passed, self.since, self.iterations = self.share(step), step, iterations
