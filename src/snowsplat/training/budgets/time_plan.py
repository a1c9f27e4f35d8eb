"""Plans a training run for a given time on this machine: photo size, number of Gaussians, steps.

If there is more time, first the number of steps is increased, then the size of the photos, then the
number of Gaussians: see docs/performance.md.
"""

import math
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

import torch

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.training.budgets.pace import FEWEST_STEPS
from snowsplat.training.budgets.step_cost import Work
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.names import changed
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.starts import map_pixels
from snowsplat.training.starts.init import initial_count
from snowsplat.util.messages import Message, message

# The size of the photos is reduced until there is time for both of these minimum numbers of steps.
#: Minimum number of steps, per square root of the number of pixels of a photo. Larger photos show
#: more detail, which more Gaussians have to represent. 2000, the number of the default recipe, is
#: the minimum for half a megapixel.
_MIN_STEPS_PER_SIDE = 3.0
#: Minimum number of steps per training photo, and the longer side down to which photos are reduced
#: for it. A few more passes over even smaller photos would lose more than they gain.
_MIN_STEPS_PER_PHOTO, _SIDE_FOR_PASSES = 10, 400
#: Minimum and maximum of the longer side of the photos, in pixels.
_MIN_SIDE = 200
_MAX_SIDE = 1600
#: The limit of the number of Gaussians is raised if there is time for more steps than this.
_STEPS_FOR_MORE_GAUSSIANS = 3000
#: Maximum factor by which this limit is raised.
_MAX_GAUSSIAN_FACTOR = 2.0
#: Minimum number of densifications in the first half of a short training run. The minimum interval
#: between densifications has priority.
_MIN_DENSIFICATIONS = 15
#: Minimum interval between densifications, in steps.
_MIN_DENSIFY_INTERVAL = 25
#: Seconds before the first step, for preparation and for decoding the first photos.
_SETUP_SECONDS = 0.5
#: Seconds for a million pixels of depth maps, on the machine of `step_cost`.
_SECONDS_PER_MAP_MEGAPIXEL = 0.2
#: Depth maps are made smaller, so that they need at most this share of the time.
_MAX_SHARE_OF_MAPS = 0.25
#: Minimum of their longer side, in pixels.
_MIN_MAP_SIDE = 100

# The speed of the machine is measured by a short training run, called the sample.
#: Maximum duration of the sample, in seconds.
_SAMPLE_SECONDS = 0.7
#: Maximum number of steps of the sample.
_SAMPLE_STEPS = 100
#: Minimum number of steps of the sample, even if they take longer than `_SAMPLE_SECONDS`.
_MIN_SAMPLE_STEPS = 3
#: Number of photos in the sample. It is small, so that decoding takes little time.
_SAMPLE_PHOTOS = 2
#: Maximum number of initial points in the sample. It limits the memory.
_SAMPLE_POINTS = 20_000
#: Photos with more pixels than this are reduced to half the width and height.
_SAMPLE_PIXELS = 500_000
#: Factor of the scales in the sample if the dataset has no points. Random points are far apart, so
#: their Gaussians would touch several times as many tiles as those of a scene.
_SAMPLE_SCALE = 0.2
#: Time of a step with a trained scene, divided by that with the initial points. It is larger than
#: 1, because more splats overlap in a trained scene. Measured with fox and fern: 1.5 to 1.9.
_TRAINED_SLOWDOWN = 1.5


@dataclass(frozen=True)
class Plan:
    """The result of `make_plan`.

    Attributes:
        resolution: width of the photos, as for `load_dataset`; None: original size.
        width, height: of a photo at that resolution, in pixels.
        config: the configuration, with the chosen number of steps and limit of Gaussians.
        time_ratio: seconds of a step on this machine, divided by `Work.seconds`.
        seconds: mean time of a step, in seconds.
    """

    resolution: int | None
    width: int
    height: int
    config: TrainConfig
    time_ratio: float
    seconds: float

    def summary(self) -> Message:
        """The plan in a few words."""
        gaussians = message("no limit on the number of Gaussians")
        if cap := self.config.density.max_gaussians:
            gaussians = message("at most {cap:,} Gaussians", cap=cap)
        size = message("{width}x{height}", width=self.width, height=self.height)
        if self.resolution is not None:
            size = message("photos reduced to {size}", size=size)
        digits = 2 - len(str(self.config.iterations))
        steps = round(self.config.iterations, min(0, digits))
        return message(
            "{size}, {gaussians}, about {steps:,} steps",
            size=size,
            gaussians=gaussians,
            steps=steps,
        )


def make_plan(
    dataset: Dataset,
    config: TrainConfig,
    seconds: float,
    time_ratio: float,
    *,
    resize: bool = True,
    more_gaussians: bool = True,
    more_often: bool = True,
) -> Plan:
    """The best training run that fits into ``seconds``.

    Args:
        dataset: at full resolution.
        config: the configuration of the recipe; its ``iterations`` are ignored.
        time_ratio: the result of `measure_time_ratio`.
        resize: whether the photos may be reduced.
        more_gaussians: whether the limit of the number of Gaussians may be raised.
        more_often: whether densification may be more frequent in a short training run.
    """
    camera = max((view.camera for view in dataset.train), key=lambda c: c.width * c.height)
    longer = max(camera.width, camera.height)

    def plan(side: int, gaussian_factor: float = 1.0) -> Plan:
        width = camera.width if side >= longer else max(1, round(camera.width * side / longer))
        height = round(camera.height * width / camera.width)
        sized = _capped(config, width * height, gaussian_factor)
        per_pixel = 1e-6 * _SECONDS_PER_MAP_MEGAPIXEL * time_ratio
        most = _MAX_SHARE_OF_MAPS * max(0.0, seconds) / per_pixel
        sized, maps = _with_maps(sized, dataset, width, height, most)
        left = seconds - _SETUP_SECONDS - per_pixel * maps
        work = Work(sized, width * height, len(dataset.test))
        initial = initial_count(dataset, sized)
        steps, mean = _steps(work, left, time_ratio, initial)
        sized = replace(sized, iterations=steps).staged(len(dataset.train))
        work = replace(work, config=sized)
        steps, mean = _steps(work, left, time_ratio, initial)
        if more_often:
            sized = _densified_in(sized, steps)
            work = replace(work, config=sized)
            steps, mean = _steps(work, left, time_ratio, initial)
        resolution = None if width == camera.width else width
        return Plan(resolution, width, height, replace(sized, iterations=steps), time_ratio, mean)

    side = longer
    if resize:
        side = min(longer, _MAX_SIDE)
        smallest = min(longer, _MIN_SIDE)
        while side > smallest and (
            (tried := plan(side)).config.iterations < _least_steps(tried, len(dataset.train))
        ):
            side = max(smallest, min(side - 8, round(0.97 * side)))
    best = plan(side)
    enough = max(_STEPS_FOR_MORE_GAUSSIANS, _least_steps(best, len(dataset.train)))
    if more_gaussians and best.config.iterations > enough:
        best = plan(side, min(_MAX_GAUSSIAN_FACTOR, best.config.iterations / enough))
    return best


def measure_time_ratio(
    dataset: Dataset,
    config: TrainConfig,
    device: torch.device | None = None,
    *,
    resize: bool = True,
) -> float:
    """Measure the seconds of a training step on this machine, divided by `Work.seconds`.

    Args:
        device: the device to train on; default: the CPU.
        resize: whether `make_plan` may reduce the photos. If so, photos above its maximum size are
            also reduced here. Otherwise the sample could need more time and memory than training.
    """
    views = dataset.train[:_SAMPLE_PHOTOS]
    if resize:
        views = [_at_most_max_side(view) for view in views]
    camera = views[0].camera
    downscale = 1 if camera.width * camera.height < _SAMPLE_PIXELS else 2
    points = dataset.points
    if points is not None and len(points) > _SAMPLE_POINTS:
        every = math.ceil(len(points) / _SAMPLE_POINTS)
        points = Points(points.xyz[::every], points.rgb[::every])
    trainer = Trainer(
        replace(dataset, train=views, test=[], points=points),
        replace(
            config,
            init="points",
            initial_points=_SAMPLE_POINTS,
            initial_scale=config.initial_scale if points is not None else _SAMPLE_SCALE,
            iterations=_SAMPLE_STEPS,
            coarse_to_fine=(0, 0) if downscale == 1 else (0, 1.0),
            sh_interval=0,
            test_iterations=(),
        ),
        device=device,
    )
    work = Work(trainer.config, camera.width * camera.height, 0)
    end = time.monotonic() + _SAMPLE_SECONDS
    ratios: list[float] = []
    while trainer.step < _SAMPLE_STEPS and (
        len(ratios) < _MIN_SAMPLE_STEPS or time.monotonic() < end
    ):
        before = time.monotonic()
        trainer.step_once()
        modelled = work.seconds(downscale, len(trainer.gaussians))
        ratios.append((time.monotonic() - before) / modelled)
    # The first step is not used, because it waits until its photo is decoded.
    return _TRAINED_SLOWDOWN * statistics.median(ratios[1:])


def _at_most_max_side(view: View) -> View:
    """The view, reduced to `_MAX_SIDE` if it is larger."""
    camera = view.camera.reduced(_MAX_SIDE)
    size: dict[str, Any] = {"width": camera.width, "height": camera.height}
    mask = view.mask and replace(view.mask, **size)
    return replace(view, camera=camera, image=replace(view.image, **size), mask=mask)


def _capped(config: TrainConfig, pixels: int, gaussian_factor: float) -> TrainConfig:
    """``config`` with the limit of Gaussians for photos of this number of pixels.

    If the configuration has a limit, it is multiplied by ``gaussian_factor`` first.
    """
    cap = config.density.max_gaussians
    if gaussian_factor > 1.0 and cap:
        config = replace(
            config, density=changed(config, max_gaussians=round(gaussian_factor * cap)).density
        )
    return config.capped(pixels, views=0)  # the limit follows the time, not the views


def _least_steps(plan: Plan, photos: int) -> float:
    """The minimum number of steps for photos of the size of the plan."""
    least = _MIN_STEPS_PER_SIDE * math.sqrt(plan.width * plan.height)
    if max(plan.width, plan.height) <= _SIDE_FOR_PASSES:
        return least
    return max(least, _MIN_STEPS_PER_PHOTO * photos)


def _with_maps(
    config: TrainConfig, dataset: Dataset, width: int, height: int, most: float
) -> tuple[TrainConfig, int]:
    """``config`` with depth maps of at most ``most`` pixels together, and their number of pixels.

    If they would be too small, there are none, and no dense initialisation; but a dataset without
    points has no other start that a short training could use.
    """
    if "sweep" not in config.starts:
        return config, 0
    photos, longer = len(dataset.train), max(width, height)
    if map_pixels(photos, width, height, config.sweep_side) > most:
        fitting = int(longer * math.sqrt(most / (photos * width * height)))
        if fitting < _MIN_MAP_SIDE and dataset.points is not None:
            init = "+".join(name for name in config.starts if name != "sweep") or "points"
            return replace(config, init=init), 0
        side = min(config.sweep_side, max(fitting, _MIN_MAP_SIDE))
        config = replace(config, sweep_side=side)
    return config, map_pixels(photos, width, height, config.sweep_side)


def _densified_in(config: TrainConfig, steps: int) -> TrainConfig:
    """``config`` with more frequent densification if there are few ``steps``."""
    interval = max(_MIN_DENSIFY_INTERVAL, steps // (2 * _MIN_DENSIFICATIONS))
    density = config.density
    begin = density.densify_from
    return changed(
        config,
        densify_interval=min(density.densify_interval, interval),
        densify_from=begin if isinstance(begin, float) else min(begin, interval),
    )


def _steps(work: Work, seconds: float, time_ratio: float, gaussians: int) -> tuple[int, float]:
    """The number of steps that fit into ``seconds`` (at least `FEWEST_STEPS`), and the mean seconds
    of a step."""
    steps = work.config.iterations
    mean = 0.0
    for _ in range(5):  # fixed-point iteration: the mean depends on the number of steps
        parts = work.parts_ahead(Schedule(steps), 0, gaussians)
        mean = time_ratio * sum(work.seconds(*part) for part in parts) / len(parts)
        left = seconds - work.seconds_after(
            time_ratio * work.seconds(1, parts[-1][1]), parts[-1][1]
        )
        steps = max(FEWEST_STEPS, round(left / mean))
    return steps, mean
