"""`Pace`: the time until the end of a training, and the steps for which a time budget suffices.

The time of a step depends on the resolution of the coarse-to-fine stage, on the number of
Gaussians, and on the load of the machine by other processes. The first steps use small photos and
few Gaussians, so their number per second is too high for the later ones. The time of every step is
measured, and the mean time of the remaining steps is estimated from recent steps. With a time
budget, `Schedule.stretch` then distributes the rest of the schedule over as many steps as there is
time for. No part of the schedule is skipped.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from snowsplat.training.budgets.step_cost import GROWTH, StepCost, Work
from snowsplat.training.settings.schedule import Schedule

#: Number of seconds over which measurements are averaged without a time budget.
_AVERAGING_SECONDS = 10.0
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


@dataclass
class TimeBudget:
    """The time that a training run may take, from the start of the command to its end."""

    seconds: float  # total time, including earlier runs
    spent: float = 0.0  # seconds in earlier runs, up to the checkpoint
    # When this run started, by `time.monotonic`.
    started: float = field(default_factory=time.monotonic)

    @property
    def left(self) -> float:
        """The seconds that are left; negative if the time is over."""
        return self.seconds - self.spent - (time.monotonic() - self.started)

    def as_json(self) -> dict[str, float]:
        """The JSON value for a checkpoint: ``seconds``, and the present value of ``spent``."""
        return {"seconds": self.seconds, "spent": self.seconds - self.left}


class Pace:
    """Call `after_step` after each step of a training run.

    Attributes:
        end: when the scene is evaluated and written; with a time budget, when this is over.
    """

    def __init__(
        self,
        work: Work,
        seconds: float | None = None,
        time_ratio: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            work: what the time of the steps depends on.
            seconds: the time budget: from now to the end, including evaluation on the test photos
                and saving; None: there is none.
            time_ratio: see `StepCost`.
            clock: returns the time in seconds.
        """
        self._work, self._clock = work, clock
        self._limited = seconds is not None
        averaging = _AVERAGING_SECONDS
        if seconds is not None:
            averaging = max(_MIN_AVERAGING_SECONDS, _AVERAGING_SHARE * seconds)
        self._cost = StepCost(work, time_ratio, averaging)
        self._last_step = clock()
        self._last_estimate = self._last_step if self._limited else -math.inf
        self._gaussians, self._growth = 0, GROWTH  # in the last step; by the last densification
        self.end = self._finish = self._last_step + (seconds or 0.0)
        self._last_part = 0.0  # seconds after the end

    def after_step(
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
        if gaussians > self._gaussians > 0:
            self._growth = gaussians / self._gaussians
        self._gaussians = gaussians
        if now - self._last_estimate < _MIN_INTERVAL:
            return None
        self._last_estimate = now
        growth = None if self._limited else self._growth
        ahead = self._work.parts_ahead(schedule, step, gaussians, growth)
        mean, at_end = self._cost.mean(ahead), self._cost.predict(1, ahead[-1][1])
        self._last_part = self._work.last_part * at_end
        after = self._work.seconds_after(self._cost.predict(1, gaussians), gaussians)
        if not self._limited:
            self.end = now + mean * (schedule.iterations - step) + after
        if not self._limited or step >= schedule.iterations:
            return None
        steps = round((self.end - now - after) / mean)
        fewest = math.ceil((1.0 - schedule.share(step)) * step / _MAX_SHORTENING)
        steps = max(steps, fewest, FEWEST_STEPS - step, 1)
        self._finish = now + mean * steps + after
        return step + steps

    @property
    def seconds_left(self) -> float:
        """The time from the last step to `end`, or longer if the budget does not suffice, and that
        of the last part of the work."""
        end = max(self.end, self._finish)
        return max(0.0, end - self._last_step) + self._last_part

    def postpone(self, seconds: float) -> None:
        """The training has paused for ``seconds`` since the last step."""
        self.end += seconds
        self._finish += seconds
        self._last_step += seconds
        self._last_estimate += seconds
