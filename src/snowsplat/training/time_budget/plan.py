"""What to train in a given time on this machine: how large photos, how many Gaussians and steps.

More steps first, then larger photos, then more Gaussians: see "Training in a given time" in
docs/performance.md.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, replace

import torch

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.training.config import TrainConfig, changed
from snowsplat.training.step_schedule import Schedule
from snowsplat.training.time_budget.pace import Work
from snowsplat.training.trainer import Trainer

# As many steps as the largest photos are worth: so many, and so many looks at each photo.
_STEPS, _LOOKS = 1000, 10
# Where there are few steps, Gaussians are added more often: so many times in each half, but with so
# many steps between.
_DENSIFICATIONS, _FEWEST_BETWEEN = 15, 25
# The longer side of photos, in pixels.
_SMALLEST, _LARGEST = 400, 1600
# Where there is time for so many steps with the recipe's cap, it may rise, so far.
_STEPS_TO_SPARE, _RISE = 4500, 2.0
# How the speed is measured: seconds and steps at most, photos, points.
_SECONDS, _SAMPLE_STEPS, _PHOTOS, _POINTS = 0.7, 100, 2, 20_000
# By how much a trained scene is slower: more splats lie behind each other (fox, fern: 1.5 to 1.9).
_TRAINED = 1.5
# Time to load the photos of the first steps and to set up, in seconds.
_SETTING_UP = 0.5


@dataclass(frozen=True)
class Plan:
    """What `make_plan` chose.

    Attributes:
        resolution: width of the photos, as -r takes it; None: as they are.
        width, height: of a photo at that resolution, in pixels.
        config: the configuration with the number of steps and the cap.
        slowness: how many times as long as reckoned a step takes here, see `pace.Work`.
        seconds: of a step, the mean.
    """

    resolution: int | None
    width: int
    height: int
    config: TrainConfig
    slowness: float
    seconds: float

    def __str__(self) -> str:
        cap = self.config.density.max_gaussians
        gaussians = f"at most {cap:,} Gaussians" if cap else "no limit of Gaussians"
        return (
            f"{self.width}x{self.height}, {gaussians}, about {_rounded(self.config.iterations):,} "
            "steps"
        )


def make_plan(
    dataset: Dataset,
    config: TrainConfig,
    seconds: float,
    slowness: float,
    *,
    resize: bool = True,
    more_gaussians: bool = True,
    more_often: bool = True,
) -> Plan:
    """The best training of ``capture`` (at full resolution) that fits into ``seconds``.

    Args:
        config: of the recipe; its ``iterations`` are replaced.
        slowness: from `measure_slowness`.
        resize: choose the size of the photos, or leave it.
        more_gaussians: whether the cap may rise.
        more_often: whether a short training may densify more often.
    """
    camera = max((view.camera for view in dataset.train), key=lambda c: c.width * c.height)
    longer = max(camera.width, camera.height)
    wanted = max(_STEPS, _LOOKS * len(dataset.train))

    def plan(side: int, rise: float = 1.0) -> Plan:
        width = camera.width if side >= longer else max(1, round(camera.width * side / longer))
        height = round(camera.height * width / camera.width)
        sized = _capped(config, width * height, rise)
        work = Work(sized, width * height, len(dataset.test))
        start = config.initial_points if dataset.points is None else len(dataset.points)
        start = min(start, sized.density.max_gaussians or start)
        steps, mean = _steps(work, seconds - _SETTING_UP, slowness, start)
        if more_often:
            sized = _densified_in(sized, steps)
            work = replace(work, config=sized)
            steps, mean = _steps(work, seconds - _SETTING_UP, slowness, start)
        resolution = None if width == camera.width else width
        return Plan(resolution, width, height, replace(sized, iterations=steps), slowness, mean)

    side = longer
    if resize:
        side, smallest = min(longer, _LARGEST), min(longer, _SMALLEST)
        while side > smallest and plan(side).config.iterations < wanted:
            side = max(smallest, min(side - 8, round(0.97 * side)))
    best = plan(side)
    if more_gaussians and best.config.iterations > _STEPS_TO_SPARE:
        rise = min(_RISE, best.config.iterations / _STEPS_TO_SPARE)
        best = plan(side, rise)
    return best


def measure_slowness(
    dataset: Dataset,
    config: TrainConfig,
    device: torch.device | None = None,
    *,
    resize: bool = True,
) -> float:
    """How many times as long as reckoned a step takes on this machine, by a few real ones.

    Args:
        device: to train on; default: the CPU.
        resize: as of `make_plan`, which then takes photos no larger than some size. Steps on larger
            ones would take time and memory that the training does not.
    """
    views = dataset.train[:_PHOTOS]
    if resize:
        views = [_no_larger(view) for view in views]
    camera = views[0].camera
    downscale = 1 if camera.width * camera.height < 500_000 else 2
    points = dataset.points
    if points is not None and len(points) > _POINTS:
        every = math.ceil(len(points) / _POINTS)
        points = Points(points.xyz[::every], points.rgb[::every])
    trainer = Trainer(
        replace(dataset, train=views, test=[], points=points),
        replace(
            config,
            initial_points=min(config.initial_points, _POINTS),
            iterations=_SAMPLE_STEPS,
            coarse_to_fine=(0, 0) if downscale == 1 else (0, 1.0),
            sh_interval=0,
            test_iterations=(),
        ),
        device=device,
    )
    work = Work(trainer.config, camera.width * camera.height, 0)
    end = time.monotonic() + _SECONDS
    ratios: list[float] = []
    while trainer.step < _SAMPLE_STEPS and (len(ratios) < 3 or time.monotonic() < end):
        start = time.monotonic()
        trainer.step_once()
        reckoned = work.seconds(downscale, len(trainer.gaussians))
        ratios.append((time.monotonic() - start) / reckoned)
    return _TRAINED * statistics.median(ratios[1:])  # the first one waits for its photo


def _no_larger(view: View) -> View:
    """The view at the largest size that is chosen, or as it is."""
    camera, mask = view.camera, view.mask
    scale = _LARGEST / max(camera.width, camera.height)
    if scale >= 1.0:
        return view
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    return replace(
        view,
        camera=camera.scaled(width, height),
        image=replace(view.image, width=width, height=height),
        mask=mask and replace(mask, width=width, height=height),
    )


def _capped(config: TrainConfig, pixels: int, rise: float) -> TrainConfig:
    cap = config.density.max_gaussians
    if rise > 1.0 and cap:
        config = replace(config, density=changed(config, max_gaussians=round(rise * cap)).density)
    return config.capped(pixels)


def _densified_in(config: TrainConfig, steps: int) -> TrainConfig:
    interval = max(_FEWEST_BETWEEN, steps // (2 * _DENSIFICATIONS))
    density = config.density
    begin = density.densify_from
    return changed(
        config,
        densify_interval=min(density.densify_interval, interval),
        densify_from=begin if isinstance(begin, float) else min(begin, interval),
    )


def _steps(work: Work, seconds: float, slowness: float, gaussians: int) -> tuple[int, float]:
    """How many steps fit, and the seconds of one."""
    steps = work.config.iterations
    mean = 0.0
    for _ in range(5):  # what a step takes depends on how many there are
        parts = work.parts_ahead(Schedule(steps), 0, gaussians)
        mean = slowness * sum(work.seconds(*part) for part in parts) / len(parts)
        left = seconds - work.seconds_after(slowness * work.seconds(1, parts[-1][1]), parts[-1][1])
        steps = max(1, round(left / mean))
    return steps, mean


def _rounded(count: int) -> int:
    """To two digits."""
    digits = max(0, len(str(count)) - 2)
    return round(count / 10**digits) * 10**digits
