"""`Pace`: makes a training run complete its schedule within a time budget.

The time of a step depends on the resolution of the coarse-to-fine stage, on the number of
Gaussians, and on the load of the machine by other processes. The time of every step is measured,
and the mean time of the remaining steps is estimated from recent steps. `Schedule.stretch` then
distributes the rest of the schedule over as many steps as there is time for. No part of the
schedule is skipped.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from snowsplat.training.budgets.step_cost import StepCost, Work
from snowsplat.training.settings.schedule import Schedule

#: Fraction of the time budget over which measurements are averaged. It is long enough to average
#: over views, and short enough to follow a change of the load.
_AVERAGING_SHARE = 0.2
#: Minimum number of seconds over which measurements are averaged.
_MIN_AVERAGING_SECONDS = 3.0
#: Minimum number of seconds between two estimates, because an estimate takes some time.
_MIN_INTERVAL = 0.1
#: No training run has fewer steps, even if its preparation took all of the time: they take a few
#: seconds, and a scene after one step would be of no use.
FEWEST_STEPS = 100
#: The number of steps of the rest of the schedule is divided by at most this number, even if no
#: time is left.
_MAX_SHORTENING = 10.0


class Pace:
    """Keeps a training run within its time; call `iterations_after` after each of its steps."""

    def __init__(
        self,
        work: Work,
        seconds: float,
        time_ratio: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            work: what the time of the steps depends on.
            seconds: time from now to the end, including evaluation on the test photos and saving.
            time_ratio: see `StepCost`.
            clock: returns the time in seconds.
        """
        self._work = work
        self._clock = clock
        self._last_step = self._last_estimate = clock()
        self.deadline = self._last_step + seconds
        self._cost = StepCost(
            work, time_ratio, max(_MIN_AVERAGING_SECONDS, _AVERAGING_SHARE * seconds)
        )

    def iterations_after(
        self, schedule: Schedule, step: int, downscale: int, gaussians: int
    ) -> int | None:
        """The total number of steps for which there is time; None: leave the schedule unchanged.

        Args:
            step: number of completed steps.
            downscale: factor by which the photo of the last completed step was reduced.
            gaussians: number of Gaussians in that step.
        """
        now = self._clock()
        self._cost.observe(now - self._last_step, downscale, gaussians)
        self._last_step = now
        if now - self._last_estimate < _MIN_INTERVAL or step >= schedule.iterations:
            return None
        self._last_estimate = now
        steps = round(self._seconds_left(now, gaussians) / self._mean(schedule, step, gaussians))
        fewest = math.ceil((1.0 - schedule.share(step)) * step / _MAX_SHORTENING)
        return step + max(steps, fewest, FEWEST_STEPS - step, 1)

    def postpone(self, seconds: float) -> None:
        """Postpone the deadline by a pause of ``seconds`` since the last step."""
        self.deadline += seconds
        self._last_step += seconds
        self._last_estimate += seconds

    def _mean(self, schedule: Schedule, step: int, gaussians: int) -> float:
        """Mean seconds of the remaining steps."""
        return self._cost.mean(self._work.parts_ahead(schedule, step, gaussians))

    def _seconds_left(self, now: float, gaussians: int) -> float:
        """Seconds until the last step has to be completed, before the final evaluation."""
        after = self._work.seconds_after(self._cost.predict(1, gaussians), gaussians)
        return self.deadline - now - after
