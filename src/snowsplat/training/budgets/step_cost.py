"""Predicts the time of training steps: `Work` is a model, and `StepCost` calibrates it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.settings.config import TrainConfig

if TYPE_CHECKING:
    from snowsplat.data import Dataset

# Seconds of a step on the machine of docs/measurements/2026-11-25-kernels.md. Only their
# proportions matter: the time on this machine with this scene, divided by these seconds, is
# measured. It is the `time_ratio`.
_SECONDS_PER_STEP = 0.001
_SECONDS_PER_MEGAPIXEL = 0.035
_SECONDS_PER_MILLION_GAUSSIANS = 0.07

# Seconds after the last step, on the same machine.
#: Rendering a test view, as a multiple of a training step at full resolution. It is less than 1,
#: because there is no backward pass.
_STEPS_PER_VIEW = 0.5
#: Decoding the photo of a test view and computing the metrics.
_SECONDS_PER_VIEW_MEGAPIXEL = 0.05
#: Writing the scene, per million Gaussians.
_SECONDS_PER_MILLION_WRITTEN = 4.0

#: Factor by which a densification increases the number of Gaussians, below their limit.
_GROWTH = 1.25
#: The remaining steps are divided into this number of equal parts, and the time of each is
#: estimated.
_PARTS = 40

#: Weight of the initial value of `time_ratio`, relative to the weight of all measurements after a
#: long time.
_INITIAL_WEIGHT = 0.3
#: The measured time of a step is limited to this multiple of the predicted time. A longer step was
#: delayed by another process.
_OUTLIER = 5.0


@dataclass(frozen=True)
class Work:
    """What the time of a training run depends on.

    Attributes:
        config: the configuration; its coarse-to-fine stages and its densification are used.
        pixels: mean number of pixels of a photo at full resolution.
        held_out: number of test photos, which are evaluated at the end.
    """

    config: TrainConfig
    pixels: float
    held_out: int

    @classmethod
    def for_training(cls, config: TrainConfig, dataset: Dataset) -> Work:
        """The work of training on ``dataset``."""
        sizes = [view.camera.width * view.camera.height for view in dataset.train]
        return cls(config, sum(sizes) / len(sizes), len(dataset.test))

    def seconds(self, downscale: int, gaussians: float) -> float:
        """Seconds of one step on the machine of docs/measurements/2026-11-25-kernels.md."""
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

    def parts_ahead(self, schedule: Schedule, step: int, gaussians: int) -> list[tuple[int, float]]:
        """Downscale and number of Gaussians in equal parts of the steps after ``step``.

        The number of Gaussians is assumed to increase linearly until densification ends. It then is
        the limit or, without a limit, twice the present number; but each densification increases
        the number at most by the factor `_GROWTH`.
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
    """Predicts the seconds of a training step from the times of previous steps."""

    def __init__(self, work: Work, time_ratio: float, time_constant: float) -> None:
        """
        Args:
            time_ratio: initial value of the measured seconds divided by `Work.seconds`.
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
        self._time_ratio = time_ratio
        self._initial = _INITIAL_WEIGHT * time_constant / time_ratio

    def observe(self, seconds: float, downscale: int, gaussians: int) -> None:
        """Add the measured ``seconds`` of a step."""
        expected = self.predict(downscale, gaussians)
        seconds = min(seconds, _OUTLIER * expected)
        if downscale not in self._measured:
            self._measured[downscale] = self._initial * self._time_ratio
            self._modelled[downscale] = self._initial
        keep = math.exp(-seconds / self._time_constant)
        modelled = self._work.seconds(downscale, gaussians)
        self._measured[downscale] = keep * self._measured[downscale] + seconds
        self._modelled[downscale] = keep * self._modelled[downscale] + modelled
        self._time_ratio = self._measured[downscale] / self._modelled[downscale]

    def predict(self, downscale: int, gaussians: float) -> float:
        """Seconds of a step; a stage without measurements has the time ratio of the last step."""
        time_ratio = self._time_ratio
        if downscale in self._measured:
            time_ratio = self._measured[downscale] / self._modelled[downscale]
        return time_ratio * self._work.seconds(downscale, gaussians)
