"""Predicts the time of training steps: `Work` is a model, and `StepCost` calibrates it."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.schedule import Schedule

if TYPE_CHECKING:
    from snowsplat.data import Dataset

# Seconds of a step on two cores of a Zen 5 with AVX-512. Only their
# proportions matter: the time on this machine with this scene, divided by these seconds, is
# measured. It is the `time_ratio`. The fixed part is small: with fox and lego, steps at a quarter
# of the width take no more than their pixels and Gaussians account for.
_SECONDS_PER_STEP = 0.0003
_SECONDS_PER_MEGAPIXEL = 0.035
_SECONDS_PER_MILLION_GAUSSIANS = 0.07

# Seconds after the last step, on the same machine.
#: Rendering a test view, as a multiple of a training step at full resolution. It is less than 1,
#: because there is no backward pass.
_STEPS_PER_VIEW = 0.5
#: Decoding the photo of a test view and computing the metrics.
_SECONDS_PER_VIEW_MEGAPIXEL = 0.05
#: Preparing a photo for the last part: decoding it, and comparing it with the scene.
_STEPS_PER_PHOTO = 2.0
#: Writing the scene, per million Gaussians.
_SECONDS_PER_MILLION_WRITTEN = 4.0

#: Factor by which a densification increases the number of Gaussians, below their limit.
GROWTH = 1.25
#: The remaining steps are divided into this number of equal parts, and the time of each is
#: estimated.
_PARTS = 40

#: Weight of a known initial value of `time_ratio`, relative to the weight of all measurements after
#: a long time; and of that of the first step, in steps.
_INITIAL_WEIGHT, _INITIAL_STEPS = 0.3, 5
#: A step that takes more than the first multiple of the predicted time, after one that did not,
#: contains something rare: a densification, or masks of what moves. If long steps follow each
#: other, the machine has become slow; the time of each is limited to the second multiple.
_LONG, _LONGEST = 3.0, 5.0
#: How often something rare happens is known from the steps since this number of times before: there
#: are no densifications in the last part of a training.
_TIMES = 6


@dataclass(frozen=True)
class Work:
    """What the time of a training run depends on.

    Attributes:
        config: the configuration; its coarse-to-fine stages and its densification are used.
        pixels: mean number of pixels of a photo at full resolution.
        held_out: number of test photos, which are evaluated at the end.
        last_part: what follows the evaluation, in steps at full resolution. A time budget does not
            contain it.
    """

    config: TrainConfig
    pixels: float
    held_out: int
    last_part: float = 0.0

    @classmethod
    def for_training(cls, config: TrainConfig, dataset: Dataset, last_part: float = 0.0) -> Work:
        """The work of training on ``dataset``.

        ``last_part``: steps that follow with all photos, relative to those of the training.
        """
        sizes = [view.camera.width * view.camera.height for view in dataset.train]
        more = last_part * config.iterations
        if more:
            more += _STEPS_PER_PHOTO * (len(dataset.train) + len(dataset.test))
        return cls(config, sum(sizes) / len(sizes), len(dataset.test), more)

    def seconds(self, downscale: int, gaussians: float) -> float:
        """Seconds of one step on the machine of these constants."""
        megapixels = self.pixels / downscale**2 / 1e6
        return (
            _SECONDS_PER_STEP
            + _SECONDS_PER_MEGAPIXEL * megapixels
            + _SECONDS_PER_MILLION_GAUSSIANS * gaussians / 1e6
        )

    def seconds_after(self, step: float, gaussians: float) -> float:
        """Seconds after the last step, for evaluating the test views and writing the scene.

        Args:
            step: seconds of a step at full resolution.
            gaussians: number of Gaussians at the end.
        """
        view = _STEPS_PER_VIEW * step + _SECONDS_PER_VIEW_MEGAPIXEL * self.pixels / 1e6
        return self.held_out * view + _SECONDS_PER_MILLION_WRITTEN * gaussians / 1e6

    def parts_ahead(
        self, schedule: Schedule, step: int, gaussians: int, growth: float | None = None
    ) -> list[tuple[int, float]]:
        """Downscale and number of Gaussians in equal parts of the steps after ``step``.

        The number of Gaussians is assumed to increase until densification ends, up to the limit or,
        without a limit, to twice the present number. Each densification multiplies it by
        ``growth``. If that is None, the increase is linear, and at most that of `GROWTH`.
        """
        density = self.config.density
        every = density.densify_interval
        last = min(schedule.step_of(density.densify_until), schedule.iterations)
        most = max(gaussians, density.max_gaussians or 2 * gaussians)

        def grown(times: int, factor: float) -> float:
            return min(most, gaussians * factor ** min(max(0, times), 99))

        at_end = grown((last - step) // every, GROWTH)
        parts = []
        for i in range(_PARTS):
            at = step + (i + 0.5) / _PARTS * (schedule.iterations - step)
            if growth is not None:
                count = grown(int(min(at, last)) // every - step // every, growth)
            else:
                share = min(1.0, (at - step) / (last - step)) if last > step else 0.0
                count = gaussians + share * (at_end - gaussians)
            parts.append((self.config.downscale_at(math.ceil(at), schedule), count))
        return parts


class StepCost:
    """Predicts the seconds of a training step from the times of previous steps."""

    def __init__(self, work: Work, time_ratio: float | None, time_constant: float) -> None:
        """
        Args:
            time_ratio: initial value of the measured seconds divided by `Work.seconds`; None: that
                of the second step, because the first one waits until its photo is decoded.
            time_constant: seconds after which the weight of a measurement has decreased to 1/e.
        """
        self._work = work
        self._time_constant = time_constant
        # For each downscale: sums of measured and of modelled seconds, with exponentially
        # decreasing weights. The sums of a stage start with the time ratio of the previous stage.
        # This initial value has a larger weight than the first steps of the stage, because these
        # wait until photos are decoded.
        self._measured: dict[int, float] = {}
        self._modelled: dict[int, float] = {}
        self._known = time_ratio is not None
        self._time_ratio = 1.0 if time_ratio is None else time_ratio
        self._initial = _INITIAL_WEIGHT * time_constant / self._time_ratio
        self._steps = 0
        # The last long steps, and what they took in addition.
        self._rare: deque[tuple[int, float]] = deque(maxlen=_TIMES + 1)
        self._long = False  # whether the last step was long

    def observe(self, seconds: float, downscale: int, gaussians: int) -> None:
        """Add the measured ``seconds`` of a step."""
        modelled = self._work.seconds(downscale, gaussians)
        self._steps += 1
        if not self._known and self._steps <= 2:
            self._time_ratio = seconds / modelled
            return
        expected = self.predict(downscale, gaussians)
        was_long, self._long = self._long, seconds > _LONG * expected
        if self._long and not was_long:
            self._rare.append((self._steps, seconds - expected))
            seconds = expected
        seconds = min(seconds, _LONGEST * expected)
        if downscale not in self._measured:
            initial = self._initial if self._known else _INITIAL_STEPS * modelled
            self._measured[downscale] = initial * self._time_ratio
            self._modelled[downscale] = initial
        keep = math.exp(-seconds / self._time_constant)
        self._measured[downscale] = keep * self._measured[downscale] + seconds
        self._modelled[downscale] = keep * self._modelled[downscale] + modelled
        self._time_ratio = self._measured[downscale] / self._modelled[downscale]

    def predict(self, downscale: int, gaussians: float) -> float:
        """Seconds of a step; a stage without measurements has the time ratio of the last step."""
        time_ratio = self._time_ratio
        if downscale in self._measured:
            time_ratio = self._measured[downscale] / self._modelled[downscale]
        return time_ratio * self._work.seconds(downscale, gaussians)

    def mean(self, parts: Sequence[tuple[int, float]]) -> float:
        """Mean seconds of the steps of ``parts``, see `Work.parts_ahead`, with what is rare.

        The usual time of what is rare is its median. A step during which the computer has slept
        does not change it.
        """
        rare = 0.0
        if len(self._rare) > 1:
            usual = statistics.median_low(extra for _, extra in self._rare)
            since, times = 0, len(self._rare)
            if times > _TIMES:
                since, times = self._rare[0][0], _TIMES
            rare = usual * times / (self._steps - since)
        return sum(self.predict(*part) for part in parts) / len(parts) + rare
