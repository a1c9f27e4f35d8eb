"""`TimeLeft`: estimates the time until a job is finished, from the progress of its steps.

The steps of structure from motion have very different costs, and the longest are the last ones. So
every step has a predicted work (`sfm.cost`), in seconds of one core of a reference machine. Two
factors convert work to time on this machine. Both are measured while the job runs:

    slowness   the time that one core of this machine needs for some work, divided by the time that
               one core of the reference machine needs. The slowness of the machine is measured in
               the steps whose work is well predicted (`_PARALLEL`). In addition, each step has its
               own slowness. It starts at that of the machine, and is measured as soon as a part of
               the step is finished. The initial value counts as much as the share `_PRIOR` of the
               step
    cores      the number of cores that the job gets, at most its number of threads; less than 1 if
               other jobs use most of the machine. It is measured while all threads work: processor
               time divided by wall time

Some steps become slower while they run: registering a photo takes longer if the model is large. The
progress of a step is therefore given as a share of its work, not of its items.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from snowsplat.sfm.colmap.options import EFFORTS
from snowsplat.sfm.cost import Step, expected_pairs, share_of_poses, steps_of, steps_of_pairs

if TYPE_CHECKING:
    from snowsplat.sfm.cost import Photos
    from snowsplat.sfm.options import EffortName
    from snowsplat.sfm.progress import Report

#: The initial value of the slowness of a step counts as much as this share of its work.
_PRIOR = 0.1
#: The slowness of the machine starts at 1. This value counts as much as this share of all work.
_START = 0.01
#: Steps in which all threads work all the time, and whose work depends little on the scene.
_PARALLEL = ("photos", "features", "images")
#: Cores are measured for at least this time, in seconds.
_MEASURED_SECONDS = 2.0
#: Minimum of the measured number of cores.
_FEWEST_CORES = 0.05
#: Between two progress reports, the time left decreases. It is at least this share of the time
#: since the last report.
_SILENCE = 0.25


class TimeLeft:
    """Call `update` when a part of a step is finished. `seconds` is the time that is left."""

    def __init__(
        self,
        steps: Mapping[str, Step],
        threads: int,
        clock: Callable[[], float] = time.monotonic,
        cpu_clock: Callable[[], float] = time.process_time,
    ) -> None:
        """
        Args:
            steps: all steps of the job, in their order.
            threads: number of threads of the job.
            clock, cpu_clock: return the time, and the processor time of this process, in seconds.
        """
        self._steps = dict(steps)
        self._clock, self._cpu_clock = clock, cpu_clock
        self._child = 0.0  # processor time of the child process
        self._cores = float(threads)
        self._threads = threads
        self._step, self._share = next(iter(steps)), 0.0
        # Wall time and processor time: at the start of the current step, and at the last progress.
        self._began = self._last = clock()
        self._began_cpu = self._last_cpu = cpu_clock()
        # For each step: the measured core seconds, and the work that was finished in this time.
        self._measured = dict.fromkeys(steps, 0.0)
        self._finished = dict.fromkeys(steps, 0.0)
        self._estimate = self._sum()

    def expect(self, steps: Mapping[str, Step]) -> None:
        """Replace some of the steps, because more is known about their work."""
        self._steps |= steps
        self._estimate = self._sum()

    def update(self, step: str, share: float) -> None:
        """``share`` (0 to 1) of the work of ``step`` is finished.

        The steps before it are finished. If a step is repeated, its share becomes smaller.
        """
        if step == self._step and share == self._share:
            return
        now, cpu = self._clock(), self._cpu_clock() + self._child
        if step != self._step:
            if 0.0 < self._share < 1.0:
                seconds = (now - self._last) * self._cores_of(self._step)
                self._add(self._step, seconds, 1.0 - self._share)
            self._began, self._began_cpu = now, cpu
        elif share > self._share:
            seconds = (now - self._last) * self._cores_of(step)
            if step in _PARALLEL:
                seconds = cpu - self._last_cpu
                elapsed = now - self._began
                if elapsed > _MEASURED_SECONDS:
                    cores = (cpu - self._began_cpu) / elapsed
                    self._cores = min(max(cores, _FEWEST_CORES), self._threads)
            self._add(step, seconds, share - self._share)
        self._step, self._share = step, share
        self._last, self._last_cpu = now, cpu
        self._estimate = self._sum()

    @property
    def seconds(self) -> float:
        """Estimated seconds until the last step is finished."""
        silence = self._clock() - self._last
        return max(self._estimate - silence, _SILENCE * silence)

    def _add(self, step: str, core_seconds: float, share: float) -> None:
        self._measured[step] += core_seconds
        self._finished[step] += share * self._steps[step].work

    def _cores_of(self, step: str) -> float:
        return min(self._steps[step].threads, self._cores)

    def _sum(self) -> float:
        """Seconds of the rest of this step and of the later ones."""
        names = list(self._steps)
        later = names[names.index(self._step) + 1 :]
        rest = (1.0 - self._share) * self._seconds(self._step)
        return rest + sum(map(self._seconds, later))

    def _seconds(self, step: str) -> float:
        """Seconds of the whole step on this machine."""
        work = self._steps[step].work
        if not work:
            return 0.0
        start = _START * sum(step.work for step in self._steps.values())
        typical = [name for name in _PARALLEL if name in self._steps]
        measured = sum(self._measured[name] for name in typical)
        finished = sum(self._finished[name] for name in typical)
        slowness = (measured + start) / (finished + start)
        prior = _PRIOR * work
        own = (self._measured[step] + prior * slowness) / (self._finished[step] + prior)
        return own * work / self._cores_of(step)


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

    work: float = 0.0  # seconds of one core of the reference machine; all threads work
    # When the job will end because of its time budget, by `time.monotonic`; None: there is no time
    # budget.
    deadline: float | None = None


class SfmTimeLeft(TimeLeft):
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
        steps = steps_of(photos, size, effort)
        del steps["start"]  # its time is spread over other steps, so it is not measured
        super().__init__({**steps, "later": Step(later.work)}, threads)
        self._pairs = 0  # number of pairs that are matched; 0: not known yet
        self._features = 0.0  # mean number of features of a photo; 0: not known yet
        self._deadline = later.deadline

    def report(self, stage: str, report: Report) -> Report:
        """A progress callback for a stage: it adds the time left and calls ``report``."""

        def with_time(done: int, total: int, what: str = "", left: float | None = None) -> None:
            self._update_stage(stage, done, total, what)
            left = self.seconds
            if self._deadline is not None:
                left = max(left, self._deadline - time.monotonic())
            report(done, total, what, left)

        return with_time

    def _update_stage(self, stage: str, done: int, total: int, what: str) -> None:
        step = stage
        if stage == "poses":
            step = _STEP_OF_ITEMS[what]
        elif stage == "photos" and what != "photos":
            step = "videos"
        if step == "pairs" and total != self._pairs:
            self._pairs = total
            self._expect_pairs()
        share = done / total if total else 0.0
        self.update(step, share_of_poses(done, total) if step == "poses" else share)

    def figures(self, cpu_seconds: float, features: float) -> None:
        """Figures about the child process that estimates the poses; see `progress.Figures`."""
        self._child = cpu_seconds
        if features and features != self._features:
            self._features = features
            self._expect_pairs()

    def _expect_pairs(self) -> None:
        pairs = self._pairs or expected_pairs(self._photos.count, self._effort)
        features = self._features or EFFORTS[self._effort].features
        self.expect(steps_of_pairs(pairs, features))

    def expect_photos(self, count: int) -> None:
        """The stage "photos" is finished, with ``count`` photos and frames."""
        self._photos = replace(self._photos, stills=count, frames=0)
        steps = steps_of(self._photos, self._size, self._effort)
        names = (*_STEPS_OF_STAGE["poses"], *_STEPS_OF_STAGE["images"])
        self.expect({name: steps[name] for name in names})

    def finished_before(self, stage: str) -> None:
        """``stage`` takes no time: an earlier run finished it, or it has nothing to do."""
        self.expect(dict.fromkeys(_STEPS_OF_STAGE[stage], Step(0.0)))
