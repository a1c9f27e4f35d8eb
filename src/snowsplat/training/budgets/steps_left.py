"""`StepsLeft`: estimates the time until the last step of a training run without a time budget.

The first steps use small photos and few Gaussians, so the present number of steps per second is too
high for the later ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from snowsplat.training.budgets.step_cost import GROWTH, StepCost, Work
from snowsplat.training.settings.schedule import Schedule

#: Number of seconds over which measurements are averaged.
_AVERAGING_SECONDS = 10.0
#: Minimum number of seconds between two estimates, because an estimate takes some time.
_MIN_INTERVAL = 0.2


class StepsLeft:
    """Call `after` after each step."""

    def __init__(self, work: Work, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            work: what the time of the steps depends on.
            clock: returns the time in seconds.
        """
        self._work = work
        self._clock = clock
        self._last_step = clock()
        self._cost = StepCost(work, None, _AVERAGING_SECONDS)
        self._gaussians, self._growth = 0, GROWTH  # in the last step; by the last densification
        self._end = self._last_estimate = -float("inf")

    def after(self, schedule: Schedule, step: int, downscale: int, gaussians: int) -> float:
        """Seconds until the last step is completed; the arguments are those of `Pace`."""
        now = self._clock()
        self._cost.observe(now - self._last_step, downscale, gaussians)
        self._last_step = now
        if gaussians > self._gaussians > 0:
            self._growth = gaussians / self._gaussians
        self._gaussians = gaussians
        if now - self._last_estimate >= _MIN_INTERVAL:
            self._last_estimate = now
            parts = self._work.parts_ahead(schedule, step, gaussians, self._growth)
            self._end = now + self._cost.mean(parts) * (schedule.iterations - step)
        return max(0.0, self._end - now)

    def postpone(self, seconds: float) -> None:
        """The training has paused for ``seconds`` since the last step."""
        self._last_step += seconds
        self._end += seconds
