"""`SfmTimeLeft`: estimates the time until a job is finished, from the progress of its steps.

The steps of structure from motion have very different costs, and the longest are the last ones. So
every step has a predicted time (`sfm.cost`). The *slowness* is the time that finished work has
taken, divided by its predicted time. Each step has its own; it starts at that of the whole job,
which counts as much as the share `_PRIOR` of the step.

Some steps become slower while they run: registering a photo takes longer if the model is large. The
progress of a step is therefore given as a share of its work, not of its items.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from snowsplat.sfm.cost import Speed, Step, share_of_poses, steps_of, steps_of_pairs

if TYPE_CHECKING:
    from snowsplat.sfm.cost import Photos
    from snowsplat.sfm.options import EffortName
    from snowsplat.sfm.progress import Report

_PRIOR = 0.1
#: The slowness of the job starts at 1. This value counts as much as this share of all work.
_START = 0.01
#: Between two progress reports, the time left decreases. It is at least this share of the time
#: since the last report.
_SILENCE = 0.25

# The step whose progress is reported with these names of items.
_STEP_OF_ITEMS = {
    "photos with features": "features",
    "matched pairs": "pairs",
    "verified pairs": "verified",
    "registered photos": "poses",
}
_STEPS_OF_STAGE = {
    "photos": ("videos", "photos"),
    "poses": ("features", "pairs", "verified", "poses"),
    "images": ("load", "images"),
    "report": ("report",),
}


@dataclass(frozen=True)
class Later:
    """The part of a job after structure from motion."""

    seconds: float = 0.0  # on this machine
    # When the job will end because of its time budget, by `time.monotonic`; None: there is no time
    # budget.
    deadline: float | None = None


class SfmTimeLeft:
    """Adds the time left to the progress of the stages of `make_dataset.make_dataset`."""

    def __init__(
        self, photos: Photos, size: int | None, effort: EffortName, threads: int, later: Later
    ) -> None:
        """
        Args:
            photos, size, effort: as for `cost.steps_of`.
            threads: number of threads of the job.
            later: the part of the job after structure from motion.
        """
        self._photos, self._size, self._effort = photos, size, effort
        self._later, self._speed = later, Speed(1.0, threads)
        steps = steps_of(photos, size, effort)
        del steps["start"]  # its time is spread over other steps, so it is not measured
        self._predicted = dict[str, float]()  # seconds of each step, in their order
        self.expect(steps)
        # For each step: the seconds that were measured, and the predicted ones of the same work.
        self._measured = dict.fromkeys(self._predicted, 0.0)
        self._finished = dict.fromkeys(self._predicted, 0.0)
        self._step, self._share = next(iter(self._predicted)), 0.0
        self._last = time.monotonic()

    def expect(self, steps: dict[str, Step]) -> None:
        """Replace some of the steps, because more is known about their work."""
        self._predicted |= {name: step.seconds(self._speed) for name, step in steps.items()}

    def expect_photos(self, count: int) -> None:
        """The stage "photos" is finished, with ``count`` photos and frames."""
        self._photos = replace(self._photos, stills=count, frames=0)
        steps = steps_of(self._photos, self._size, self._effort)
        names = (*_STEPS_OF_STAGE["poses"], *_STEPS_OF_STAGE["images"])
        self.expect({name: steps[name] for name in names})

    def finished_before(self, stage: str) -> None:
        """``stage`` takes no time: an earlier run finished it, or it has nothing to do."""
        self.expect(dict.fromkeys(_STEPS_OF_STAGE[stage], Step(0.0)))

    def report(self, stage: str, report: Report) -> Report:
        """A progress callback for a stage: it adds the time left and calls ``report``."""

        def with_time(done: int, total: int, what: str = "", left: float | None = None) -> None:
            step = _STEP_OF_ITEMS[what] if stage == "poses" else stage
            if stage == "photos" and what != "photos":
                step = "videos"
            if step == "pairs":  # now their number is known
                self.expect(steps_of_pairs(total, self._effort))
            share = done / total if total else 0.0
            self.update(step, share_of_poses(done, total) if step == "poses" else share)
            left = self.seconds
            if self._later.deadline is not None:
                left = max(left, self._later.deadline - time.monotonic())
            report(done, total, what, left)

        return with_time

    def update(self, step: str, share: float) -> None:
        """``share`` (0 to 1) of the work of ``step`` is finished, and the steps before it.

        If a step is repeated, its share becomes smaller.
        """
        if step == self._step and share == self._share:
            return
        now, before, more = time.monotonic(), self._step, share - self._share
        if step != before:  # the rest of the step before
            more = 1.0 - self._share if self._share > 0.0 else 0.0
        if more > 0.0:
            self._measured[before] += now - self._last
            self._finished[before] += more * self._predicted[before]
        self._step, self._share, self._last = step, share, now

    @property
    def seconds(self) -> float:
        """Estimated seconds until the job is finished."""
        names = list(self._predicted)
        later = names[names.index(self._step) + 1 :]
        rest = (1.0 - self._share) * self._seconds(self._step) + sum(map(self._seconds, later))
        silence = time.monotonic() - self._last
        return max(rest - silence, _SILENCE * silence) + self._later.seconds

    def _seconds(self, step: str) -> float:
        """Seconds of the whole step on this machine."""
        if not (predicted := self._predicted[step]):
            return 0.0
        start, prior = _START * sum(self._predicted.values()), _PRIOR * predicted
        slowness = sum(self._measured.values()) + start
        slowness /= sum(self._finished.values()) + start
        own = (self._measured[step] + prior * slowness) / (self._finished[step] + prior)
        return own * predicted
