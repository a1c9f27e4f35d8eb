"""Times a training step on a GPU: that of the trainer, on a scene that does not change.

Three times are measured. `host` is the time in which the CPU queues a step. `gpu` is the time in
which the GPU runs a step that is already queued. `wall` is the time of a step in a training run,
where the CPU waits for each loss; it is at least the longer of the other two.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from workloads import Workload

from snowsplat import ops
from snowsplat.data import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource, LoadedImage
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.cuda.launches import Execute, launch_by
from snowsplat.ops.native import LAUNCHERS
from snowsplat.scene.render import project, render
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.density import AdaptiveDensity, density_control
from snowsplat.training.parts.densification import Densification
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.step.batch import BatchView
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.step_runner import INITIAL_INSTANCES_PER_GAUSSIAN, StepRunner
from snowsplat.util.native_layout import Fields

GPU = torch.device("cuda")
EXTENT = 4.0

#: The configuration of the paper, with learning rates so small that all repetitions do the same
#: work.
CONFIG = TrainConfig(
    sh_interval=0,
    learning_rates=replace(LearningRates().scaled(1e-30), means_final=1e-36, means_steps=1.0),
    density=AdaptiveDensity(densify_until=0.5, prune_screen_size=0.0),
    test_iterations=(),
)
STEP = 1000  # of CONFIG: a step that updates the statistics of density control


@contextmanager
def sums_in_order(wanted: bool) -> Iterator[None]:
    """The settings of `snowsplat train --deterministic`."""
    before = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(wanted, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)
        torch.utils.deterministic.fill_uninitialized_memory = before


class Step:
    """The training step of one workload, on a device."""

    def __init__(self, scene: Workload, device: torch.device, capacity: int | None = None) -> None:
        """``capacity``: initial capacity in instances; None uses the trainer's estimate."""
        camera = scene.camera
        source = ImageSource(Path("not read"), camera.width, camera.height)
        points = Points(torch.rand(8, 3), torch.zeros(8, 3, dtype=torch.uint8))
        view = View("not read", camera, source)
        self.trainer = trainer = Trainer(
            Dataset([view], [], points, extent=EXTENT), CONFIG, device=device
        )
        gaussians = scene.gaussians.to(device)
        trainer.gaussians = gaussians
        trainer.optimizer = Adam(
            gaussians, CONFIG.learning_rates, schedule=trainer.schedule, extent=EXTENT
        )
        trainer.part(Densification).control = density_control(
            CONFIG.density,
            len(gaussians),
            schedule=trainer.schedule,
            extent=EXTENT,
            random_init=False,
            generator=torch.Generator(),
            device=device,
        )
        trainer.runner = StepRunner(len(gaussians), device)
        trainer.runner.capacity.instances = (
            INITIAL_INSTANCES_PER_GAUSSIAN * len(gaussians) if capacity is None else capacity
        )
        self.view = view
        self.camera = camera.to(device)
        self.background = torch.zeros(3, device=device)
        self.photo = LoadedImage(self._planes())

    @torch.no_grad()
    def _planes(self) -> Tensor:
        """(3, H, W) uint8: the camera's image with noise, so that every pixel has a gradient."""
        image = render(self.trainer.gaussians, self.camera, self.background).image.permute(2, 0, 1)
        noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
        return (255 * image + 10 * noise.to(image.device)).clamp(0, 255).to(torch.uint8)

    @torch.no_grad()
    def queue(self) -> None:
        row = torch.zeros(1, dtype=torch.int64, device=self.background.device)
        batch = [BatchView(0, self.view, self.camera, self.photo, self.background, row)]
        self.trainer._optimize(STEP, batch)

    @contextmanager
    def without_graphs(self) -> Iterator[None]:
        """Inside the with block, the kernels of a step are queued one by one."""
        graphs, self.trainer.graphs = self.trainer.graphs, None
        try:
            yield
        finally:
            self.trainer.graphs = graphs

    @contextmanager
    def visible_only(self) -> Iterator[None]:
        """Inside the with block, Adam updates only the visible Gaussians, as the default recipe."""
        optimizer = self.trainer.optimizer
        optimizer.visible_only = True
        try:
            yield
        finally:
            optimizer.visible_only = False

    def run(self) -> float:
        """A complete step, repeated until the capacity suffices; returns its loss."""
        gaussians = self.trainer.gaussians
        views, photos = [self.view], [self.photo]
        return self.trainer.runner.run(self.queue, STEP, gaussians, views, photos)[0]

    def wait(self) -> None:
        """Wait for the loss of the step that was queued last."""
        self.trainer.runner._readback.wait()

    @torch.no_grad()
    def counts(self) -> dict[str, int]:
        """The size of the task of a step: see `gpu_floor.Frame`."""
        camera, gaussians = self.camera, self.trainer.gaussians
        splats = project(gaussians, camera)
        assert splats.ids is not None
        return {
            "gaussians": len(gaussians),
            "seen": int((splats.ids >= 0).sum()),
            "instances": int(self.trainer.runner.capacity.required),
            "pairs": int(ops.count_blended(splats, camera.width, camera.height).double().sum()),
            "width": camera.width,
            "height": camera.height,
        }


class KernelClock:
    """Records events before and after every kernel that the ops launch.

    ``mark()`` records an event. ``laps`` are (native function, kernel, before, after).
    """

    def __init__(self, execute: Execute, mark: Callable[[], Any]) -> None:
        self.laps: list[tuple[str, str, Any, Any]] = []
        self._execute, self._mark = execute, mark

    @contextmanager
    def on(self, device: str) -> Iterator[None]:
        """Inside the with block, launches for tensors on this device are recorded."""
        before = LAUNCHERS[device]
        LAUNCHERS[device] = self._launch
        try:
            yield
        finally:
            LAUNCHERS[device] = before

    def _launch(self, function: str, fields: Fields) -> int:
        def marked(kernel: Kernel, name: str, blocks: int, of_kernel: Fields) -> None:
            before = self._mark()
            self._execute(kernel, name, blocks, of_kernel)
            self.laps.append((function, name, before, self._mark()))

        return launch_by(marked, function, fields)


def kernel_times(
    laps: Sequence[tuple[str, str, Any, Any]], between: Callable[[Any, Any], float]
) -> dict[str, dict[str, float]]:
    """{native function: {kernel: total time of its launches}}."""
    found: dict[str, dict[str, float]] = {}
    for function, kernel, before, after in laps:
        kernels = found.setdefault(function, {})
        kernels[kernel] = kernels.get(kernel, 0.0) + between(before, after)
    return found


def medians(repeats: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Medians of the times of each kernel."""
    return {
        function: {
            kernel: statistics.median(times[function][kernel] for times in repeats)
            for kernel in kernels
        }
        for function, kernels in repeats[0].items()
    }


# ----------------------------------------------------------------------------------------- on a GPU


def event() -> torch.cuda.Event:
    found = torch.cuda.Event(enable_timing=True)
    found.record()
    return found


def milliseconds(before: torch.cuda.Event, after: torch.cuda.Event) -> float:
    return float(before.elapsed_time(after))


class BusyGpu:
    """Keeps the GPU busy until all timed work is queued, so that the GPU never waits for the CPU.

        with busy:
            before = event(); work(); after = event()

    If the pause was too short, `late` is True and the next pause is longer.
    """

    def __init__(self, seconds: float = 0.02) -> None:
        self.late = False
        self._cycles = int(2e9 * seconds)  # clocks are below 2 GHz

    def __enter__(self) -> BusyGpu:
        torch.cuda.synchronize()
        torch.cuda._sleep(self._cycles)
        self._over = event()
        return self

    def __exit__(self, *_: object) -> None:
        self.late = bool(self._over.query())
        if self.late:
            self._cycles *= 2
        torch.cuda.synchronize()


def gpu_times(work: Callable[[], object], repeats: int) -> list[float]:
    """Milliseconds of GPU time for the work that ``work`` queues, without gaps."""
    times: list[float] = []
    busy = BusyGpu()
    for _ in range(repeats + 6):
        with busy:
            before = event()
            work()
            after = event()
        if not busy.late:
            times.append(milliseconds(before, after))
        if len(times) == repeats:
            break
    if not times:
        raise RuntimeError("the CPU could not queue a step before the GPU had finished")
    return times


def step_times(step: Step, repeats: int) -> dict[str, float]:
    """Milliseconds {"host", "gpu", "wall"}: medians of the first two, a mean of the last."""
    gpu = statistics.median(gpu_times(step.queue, repeats))
    host = []
    torch.cuda.synchronize()
    begin = time.perf_counter()
    for _ in range(repeats):
        before = time.perf_counter()
        step.queue()
        host.append(1e3 * (time.perf_counter() - before))
        step.wait()
    torch.cuda.synchronize()
    wall = 1e3 * (time.perf_counter() - begin) / repeats
    return {"host": statistics.median(host), "gpu": gpu, "wall": wall}


def stage_times(step: Step, execute: Execute, repeats: int) -> dict[str, dict[str, float]]:
    """Milliseconds of each kernel of a step: medians of {native function: {kernel: …}}.

    CUDA graphs are not used, because no event can be recorded between their kernels.
    """
    with step.without_graphs():
        return _stage_times(step, execute, repeats)


def _stage_times(step: Step, execute: Execute, repeats: int) -> dict[str, dict[str, float]]:
    found = []
    busy = BusyGpu()
    for _ in range(repeats + 6):
        clock = KernelClock(execute, event)
        with clock.on(GPU.type), busy:
            step.queue()
        if not busy.late:
            found.append(kernel_times(clock.laps, milliseconds))
        if len(found) == repeats:
            break
    if not found:
        raise RuntimeError("the CPU could not queue a step before the GPU had finished")
    return medians(found)
