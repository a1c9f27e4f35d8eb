"""`Pace`: a training that ends when its time is over, with its schedule complete.

What a step takes depends on the resolution of its stage, on the number of Gaussians, which grows,
and on what else the machine is doing. So it is measured all the time, what is left is reckoned from
that, and `Schedule.stretch` spreads the rest of the schedule over as many steps as there is time
for. No step is ever cut off, and no stage left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from snowsplat.training.config import TrainConfig
from snowsplat.training.step_schedule import Schedule

# Seconds of a step where docs/performance.md was measured. How many times as slow this machine and
# this scene are, the "slowness", is measured, so only the proportions matter.
_A_STEP = 0.001
_A_MEGAPIXEL = 0.035
_A_MILLION_GAUSSIANS = 0.07

# What a densification makes of the number of Gaussians, where the cap leaves room.
_GROWTH = 1.25

# How much of the memory the guess fills at first.
_TRUST = 0.3
# A step that seems so many times slower than the others was held up by something that will pass.
_OUTLIER = 5.0
# How long measurements are remembered, as a part of the time given and at least; and the seconds
# between two looks at them.
_MEMORY, _SHORTEST_MEMORY = 0.2, 3.0
_BETWEEN = 0.1
# So many parts of the steps left are reckoned one by one.
_PARTS = 40
# Where time has run out all the same, what is left of the schedule is run through this much faster.
_HURRY = 10.0

# The end of a training: measuring a held-out view, in steps and in seconds a megapixel (to decode
# the photo, to compare); writing the scene, in seconds a million Gaussians.
_STEPS_A_VIEW = 0.5
_SECONDS_A_MEGAPIXEL = 0.05
_SECONDS_A_MILLION_WRITTEN = 4.0


@dataclass(frozen=True)
class Work:
    """What the time of a training depends on.

    Attributes:
        config: its coarse-to-fine stages and its densification.
        pixels: of a photo at full resolution, the mean.
        held_out: photos that are measured in the end.
    """

    config: TrainConfig
    pixels: float
    held_out: int

    def seconds(self, downscale: int, gaussians: float) -> float:
        """Of a step, on the machine and the scenes of docs/performance.md."""
        megapixels = self.pixels / downscale**2 / 1e6
        return _A_STEP + _A_MEGAPIXEL * megapixels + _A_MILLION_GAUSSIANS * gaussians / 1e6

    def seconds_after(self, step: float, gaussians: float) -> float:
        """From the last step to the end: what is held out is measured, the scene is written.

        ``step``: seconds of a step at full resolution.
        """
        view = _STEPS_A_VIEW * step + _SECONDS_A_MEGAPIXEL * self.pixels / 1e6
        return self.held_out * view + _SECONDS_A_MILLION_WRITTEN * gaussians / 1e6

    def parts_ahead(self, schedule: Schedule, step: int, gaussians: int) -> list[tuple[int, float]]:
        """Downscale and number of Gaussians in equal parts of the steps after ``step``.

        Their number is taken to rise evenly until densification ends, as far as the cap lets it
        (without one, to twice as many).
        """
        density = self.config.density
        last = min(schedule.step_of(density.densify_until), schedule.iterations)
        times = max(0, last - step) // density.densify_interval
        most = min(density.max_gaussians or 2 * gaussians, gaussians * _GROWTH ** min(times, 99))
        parts = []
        for i in range(_PARTS):
            ahead = (i + 0.5) / _PARTS * (schedule.iterations - step)
            grown = min(1.0, ahead / (last - step)) if last > step else 0.0
            downscale = self.config.downscale_at(math.ceil(step + ahead), schedule)
            parts.append((downscale, gaussians + grown * max(0, most - gaussians)))
        return parts


class StepCost:
    """Seconds of a training step, learnt from those that were run."""

    def __init__(self, work: Work, slowness: float, memory: float) -> None:
        """
        Args:
            slowness: seconds measured for each second of `Work.seconds`, as a first guess.
            memory: seconds after which a measurement counts for about a third.
        """
        self._work = work
        self._memory = memory
        # By downscale: seconds measured and seconds reckoned, the older the less. A stage begins
        # with what is known from the one before, which is to outweigh that its photos have to be
        # decoded first.
        self._measured: dict[int, float] = {}
        self._reckoned: dict[int, float] = {}
        self._slowness = slowness
        self._guess = _TRUST * memory / slowness

    def observe(self, seconds: float, downscale: int, gaussians: int) -> None:
        """A step took so long."""
        expected = self.predict(downscale, gaussians)
        seconds = min(seconds, _OUTLIER * expected)
        if downscale not in self._measured:
            self._measured[downscale] = self._guess * self._slowness
            self._reckoned[downscale] = self._guess
        keep = math.exp(-seconds / self._memory)
        reckoned = self._work.seconds(downscale, gaussians)
        self._measured[downscale] = keep * self._measured[downscale] + seconds
        self._reckoned[downscale] = keep * self._reckoned[downscale] + reckoned
        self._slowness = self._measured[downscale] / self._reckoned[downscale]

    def predict(self, downscale: int, gaussians: float) -> float:
        """Seconds of such a step; of a stage to come, as if it were as slow as the one that is."""
        slowness = self._slowness
        if downscale in self._measured:
            slowness = self._measured[downscale] / self._reckoned[downscale]
        return slowness * self._work.seconds(downscale, gaussians)


class Pace:
    """Keeps one training to its time; call `iterations_after` after each of its steps."""

    def __init__(
        self,
        work: Work,
        seconds: float,
        slowness: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            seconds: from now to the end, with the measuring of the held-out photos and the saving.
            slowness: see `StepCost`.
        """
        self._work = work
        self._clock = clock
        self._before = self._looked = clock()
        self.deadline = self._before + seconds
        self._cost = StepCost(work, slowness, max(_SHORTEST_MEMORY, _MEMORY * seconds))

    def iterations_after(
        self, schedule: Schedule, step: int, downscale: int, gaussians: int
    ) -> int | None:
        """How many steps there is time for, in all; None: as many as there were.

        Args:
            step, downscale, gaussians: of the step that was just run.
        """
        now = self._clock()
        self._cost.observe(now - self._before, downscale, gaussians)
        self._before = now
        if now - self._looked < _BETWEEN or step >= schedule.iterations:
            return None
        self._looked = now
        steps = round(self._seconds_left(now, gaussians) / self._mean(schedule, step, gaussians))
        fewest = math.ceil((1.0 - schedule.share(step)) * step / _HURRY)
        return step + max(steps, fewest, 1)

    def put_off(self, seconds: float) -> None:
        """So much of the time since the last step was a pause: the end comes later by it."""
        self.deadline += seconds
        self._before += seconds
        self._looked += seconds

    def _mean(self, schedule: Schedule, step: int, gaussians: int) -> float:
        """Mean seconds of the steps that are left."""
        parts = self._work.parts_ahead(schedule, step, gaussians)
        return sum(self._cost.predict(*part) for part in parts) / len(parts)

    def _seconds_left(self, now: float, gaussians: int) -> float:
        """Until the last step has to be over."""
        after = self._work.seconds_after(self._cost.predict(1, gaussians), gaussians)
        return self.deadline - now - after
