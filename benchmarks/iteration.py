"""Times one training iteration, launch by launch.

The steps are those of `Trainer.step_once`. Learning rates are 0, so the workload does not change
and all repetitions do the same work.
"""

import importlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from workloads import Workload

from snowsplat import ops
from snowsplat.ops import AdamRates, Moments, SplatGradient, native, reference
from snowsplat.ops.gaussian_parameters import PARAMETERS
from snowsplat.scene.render import view_of
from snowsplat.util.process import single_threaded

#: Native functions by stage. Functions without one appear under their own name.
STAGES = {
    "project_cull": "project: cull",
    "project_fwd": "project: forward",
    "splats_prepare": "prepare",
    "splats_sort": "sort",
    "tiles_count": "tiles: count",
    "tiles_fill": "tiles: fill",
    "rasterize_fwd": "blend forward",
    "photometric_u8": "photometric",
    "rasterize_bwd": "blend backward",
    "splats_reduce": "reduce",
    "accumulate_screen_statistics": "density statistics",
    "adam_step": "adam step",
}
#: Everything outside of the stages: Python, autograd, memory.
REST = "rest (Python)"
TOTAL = "total"
#: Queries of sizes, which take no time: counted with the rest.
QUERIES = (
    "rasterize_has_slots",
    "splat_record_bytes",
    "tiles_parts",
    "tiles_workspace_bytes",
    "rasterize_block_bytes",
)


class Stopwatch:
    """Wall and processor seconds by stage; processor time of all threads of the process."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        self.wall[name] = self.wall.get(name, 0.0) + wall
        self.cpu[name] = self.cpu.get(name, 0.0) + cpu

    @contextmanager
    def on_launches(self) -> Iterator[None]:
        """Time each `launch`: replaces that name in all op modules."""

        def timed(name: str, *args: Any, **options: Any) -> int:
            if name in QUERIES:
                return native.launch(name, *args, **options)
            with self.stage(STAGES.get(name, name)):
                return native.launch(name, *args, **options)

        holders = [
            module
            for name, module in list(sys.modules.items())
            if name.startswith("snowsplat.ops.")
            and module is not native
            and getattr(module, "launch", None) is native.launch
        ]
        for module in holders:
            module.launch = timed  # type: ignore[attr-defined]
        try:
            yield
        finally:
            for module in holders:
                module.launch = native.launch  # type: ignore[attr-defined]


class Iteration:
    """The training iteration of one workload. ``use_reference``: with `ops.reference`."""

    def __init__(
        self, workload: Workload, *, visible_only: bool = False, use_reference: bool = False
    ):
        self.workload = workload
        self.visible_only = visible_only
        self.use_reference = use_reference
        self.ops = reference if use_reference else ops
        count = len(workload.gaussians)
        # Parameters are rows of larger tensors, as after density control in a training run.
        rows = torch.arange(count)
        zeros = workload.gaussians.map(torch.zeros_like)
        m, v = zeros.select(rows), zeros.select(rows)
        self.moments = Moments(m.parameters(), v.parameters())
        self.rates = AdamRates(dict.fromkeys(PARAMETERS, 0.0), step=1000)
        self.statistics = torch.zeros(3, count)
        self.view = view_of(workload.gaussians, workload.camera, 3)
        self.background = torch.zeros(3)
        self.target = self._photo()

    @torch.no_grad()
    def _photo(self) -> Tensor:
        """(H, W, 3) uint8: the camera's image with noise, so that every pixel has a gradient."""
        splats = self._project(ops)
        height, width = self.workload.camera.height, self.workload.camera.width
        image, _, _ = ops.rasterize(splats, width, height, self.background)
        noise = torch.randn(3, height, width, generator=torch.Generator().manual_seed(0))
        planes = 255 * image.permute(2, 0, 1) + 10 * noise
        return planes.clamp(0, 255).to(torch.uint8).permute(1, 2, 0)

    def _project(self, module: Any) -> ops.Splats2D:
        return module.project(self.workload.gaussians, self.view)

    @torch.no_grad()
    def run(
        self,
        watch: Stopwatch,
        inspect: Callable[[ops.Splats2D, Tensor], None] | None = None,
    ) -> None:
        """One iteration. ``inspect`` is called with the splats and the image before backward."""
        camera, module = self.workload.camera, self.ops
        splats = self._project(module)
        with torch.enable_grad():
            splats.packed.requires_grad_()
            image, _, _ = module.rasterize(splats, camera.width, camera.height, self.background)
            if inspect is not None:
                inspect(splats, image)
            loss = module.photometric_loss(image, self.target)
            loss.backward()
        module.accumulate_screen_statistics(splats, camera.width, camera.height, *self.statistics)
        module.adam_step(
            self.workload.gaussians,
            self.moments,
            SplatGradient.of(splats),
            self.view,
            self.rates,
            visible_only=self.visible_only,
        )

    def measure(self, repeats: int, threads: int) -> dict[str, dict[str, list[float]]]:
        """{"wall": {stage: [seconds of each repeat]}, "cpu": the same}; cpu over all threads."""
        # All modules that import `launch` must be loaded before it is replaced.
        importlib.import_module("snowsplat.ops")
        ops.set_num_threads(threads)
        laps = [self._lap(threads) for _ in range(repeats)]
        return {
            clock: {name: [lap[clock][name] for lap in laps] for name in laps[0][clock]}
            for clock in ("wall", "cpu")
        }

    def _lap(self, threads: int) -> dict[str, dict[str, float]]:
        watch, whole = Stopwatch(), Stopwatch()
        if self.use_reference:
            torch.set_num_threads(threads)
            with whole.stage(TOTAL):
                self.run(watch)
            return {"wall": whole.wall, "cpu": whole.cpu}
        with single_threaded(), watch.on_launches(), whole.stage(TOTAL):
            self.run(watch)
        lap = {}
        for clock, stages, total in (
            ("wall", watch.wall, whole.wall[TOTAL]),
            ("cpu", watch.cpu, whole.cpu[TOTAL]),
        ):
            lap[clock] = stages | {REST: total - sum(stages.values()), TOTAL: total}
        return lap
