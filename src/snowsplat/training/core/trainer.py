"""`Trainer`: Algorithm 1 of the paper. It creates `Gaussians` from a `Dataset`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset
from snowsplat.data.image_loader import ImageLoader, available_memory
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.background import Background
from snowsplat.training.core.batch import BatchView, batch_gradients
from snowsplat.training.core.config import TrainConfig
from snowsplat.training.core.finite import check_state
from snowsplat.training.core.losses import view_loss
from snowsplat.training.core.optim import Adam
from snowsplat.training.core.progress import Progress
from snowsplat.training.core.step_runner import StepRunner
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.core.view_queue import ViewQueue
from snowsplat.training.parts.decay import Decay
from snowsplat.training.parts.exposure import Exposure
from snowsplat.training.parts.limits import Limits
from snowsplat.training.parts.neutral_photos import NeutralPhotos
from snowsplat.training.parts.overfitting import Overfitting, OverfittingCheck
from snowsplat.training.parts.pose_refinement import PoseRefinement
from snowsplat.training.parts.sky import Sky, find_sky
from snowsplat.training.parts.transients import Transients, delayed
from snowsplat.training.parts.unexplained import unexplained_views
from snowsplat.training.processes.sharded_render import sharded_render
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.starts.init import initial_gaussians, starts_at_random
from snowsplat.util.errors import UserError
from snowsplat.util.process import interrupts_between_steps, single_threaded

#: There is one random generator for each kind of random choice, so that additional choices of one
#: kind do not change the others. The names are part of the checkpoint format. The index of a name
#: determines the seed of its generator, so the order must not change.
GENERATORS = ("start", "views", "background", "density")


class Trainer:
    """Trains Gaussians on a dataset.

        trainer = Trainer(dataset, TrainConfig(iterations=7000))
        trainer.run()
        trainer.gaussians

    Between two steps, `state_tensors` is the complete state. A trainer that loads it produces
    bit-identical results (on a GPU: only with `torch.use_deterministic_algorithms`).
    Between two steps, `Schedule.stretch` may change the number of steps. The trainer does this
    itself if the scene overfits.

    Attributes:
        exposure: the gains of the training photos.
        gaussians: the scene after ``step`` steps, on ``device``.
        poses: the cameras of the views, which are refined if ``TrainConfig.refine_poses`` is set.
        sky: where the photos show the sky; None: they do not, or ``TrainConfig.sky`` is not set.
        transients: the masks of what moves; see ``TrainConfig.transients``.
        within_step: True during a step. It stays True if an error or a second Ctrl-C interrupts a
            step: the state is then inconsistent and must not be saved.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: TrainConfig,
        schedule: Schedule | None = None,
        device: torch.device | None = None,
        state: dict[str, Tensor] | None = None,
        initial: Gaussians | None = None,
        shards: Shards = ALONE,
    ) -> None:
        """
        Args:
            schedule: the schedule of a resumed training run; default: ``config.iterations`` steps.
            device: the device for training; default: the CPU.
            state: the state of a resumed training run; see `load_state`.
            initial: the Gaussians to start from, of the SH degree of ``config``; default:
                `initial_gaussians`.
            shards: the processes that train together. Each of them creates a trainer with the same
                arguments, and calls the same methods.

        Raises:
            UserError: the dataset has no training views, or some points are so far apart that
                float32 cannot represent their Gaussians; or the state is not valid, see
                `load_state`.
        """
        if not dataset.train:
            raise UserError("the dataset has no training views; check its folder and its split")
        self.dataset = dataset
        sizes = sorted(view.camera.width * view.camera.height for view in dataset.train)
        self.config = config = config.capped(sizes[len(sizes) // 2], len(sizes))
        self.schedule = replace(schedule or Schedule(config.iterations), batch=config.batch)
        self.shards = shards
        self._render = sharded_render(shards)
        self.step = 0
        self.within_step = False
        self._checked = False  # whether `left_out` is decided
        self._generators = {
            name: torch.Generator().manual_seed(4 * config.seed + i)
            for i, name in enumerate(GENERATORS)
        }
        self.device = device or torch.device("cpu")
        cameras = [view.camera.to(self.device) for view in dataset.train]
        self._background = Background(
            config.background, self._generators["background"], self.device
        )
        self._images = ImageLoader(
            dataset.train,
            background=self._background.fixed,
            budget_bytes=config.image_memory
            or available_memory(self.device) // (2 * shards.in_memory),
            device=self.device,
        )
        self.poses = PoseRefinement(
            *(config.refine_poses, dataset, cameras, self._images, self.schedule),
            *(self._background.evaluation, self._render, shards),
        )
        self._queue = ViewQueue(
            *(dataset.train, self.poses.camera, self._images, self._background, self._downscale),
            *(self._generators["views"], config.batch, shards),
        )
        self.exposure = Exposure(
            *(config.exposure, dataset, self._images, self.schedule, self.device, shards),
            resumed=state is not None,
            black=config.background == "black",
        )
        neutral = NeutralPhotos(self._images, dataset.train, self.exposure.start)
        # The Gaussians of a resumed training run are replaced by those of the state.
        start = config if state is None else replace(config, init="points")
        self.sky: Sky | None = None
        first = None
        with single_threaded():
            if config.sky and initial is None:
                self.sky = find_sky(dataset, neutral, config.sky_distance)
            if shards.rank == 0 and initial is not None:
                first = initial.clone().to(self.device)
            elif shards.rank == 0:
                first = initial_gaussians(
                    dataset, start, neutral, self._generators["start"], self.device, self.sky
                )
        self.gaussians = replace(shards.scattered(first), antialiased=config.antialias)
        self._optimizer = Adam(
            self.gaussians,
            config.learning_rates,
            schedule=self.schedule,
            extent=dataset.extent,
            visible_only=config.visible_only,
            shards=shards,
        )
        density = delayed(config.density) if config.transients == "on" else config.density
        self._density = density.control(
            len(self.gaussians),
            schedule=self.schedule,
            extent=dataset.extent,
            random_init=starts_at_random(dataset, config),
            generator=self._generators["density"],
            device=self.device,
            shards=shards,
        )
        self._decay = Decay(config.decay, len(dataset.train), self.schedule)
        points = None if dataset.points is None else dataset.points.xyz
        self._limits = Limits(config, cameras, points, self.sky, self.schedule)
        self.transients = Transients(
            *(config.transients, dataset.train, neutral, self._background.evaluation),
            *(self.schedule, shards),
        )
        self._overfitting = OverfittingCheck(
            *(dataset, neutral, self.schedule, self._background.evaluation, self._render)
        )
        self._runner = StepRunner(
            *(len(self.gaussians), self.device, config.density.abs_grad, config.batch, shards)
        )
        if state is not None:
            self.load_state(state)

    @property
    def total(self) -> int:
        """The number of Gaussians of all processes."""
        return self.shards.total(len(self.gaussians))

    @property
    def left_out(self) -> tuple[int, ...]:
        """Indices of the training views that are not used any more, because the scene does not
        explain them; see ``TrainConfig.leave_out_after``.
        """
        return self._queue.left_out

    @property
    def overfitting(self) -> Overfitting | None:
        """When the scene began to overfit; see ``TrainConfig.stop_overfitting``."""
        return self._overfitting.found

    def run(
        self, on_progress: Callable[[Progress], None] | None = None, until: int | None = None
    ) -> None:
        """Run the steps up to ``until`` (default: the last step), with a report after each step.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed. It is raised after the current step, when the
                state is consistent. A second Ctrl-C interrupts immediately; see ``within_step``.
            Diverged: the loss, gradients or parameters are not finite; the message names the step.
        """
        last = math.inf if until is None else until
        with interrupts_between_steps() as raise_deferred_interrupt:
            while self.step < min(last, self.schedule.iterations):
                loss = self.step_once()
                tests = self.schedule.contains(self.step, self.config.test_iterations)
                metrics = self.evaluate() if tests else None
                if on_progress is not None:
                    iterations, downscale = self.schedule.iterations, self._downscale(self.step)
                    count = self.total
                    on_progress(Progress(self.step, loss, count, iterations, downscale, metrics))
                raise_deferred_interrupt(self.shards.any)
        self._runner.finish(self.step, self.gaussians)

    @torch.no_grad()
    def step_once(self) -> float:
        """Run one iteration of Algorithm 1, with one or a batch of views; return the mean loss.

        Raises:
            Diverged: the loss is not finite, or the update of the previous step was not finite.
        """
        self.within_step = True
        with single_threaded():
            self._leave_out_unexplained()
            self.poses.after_step(self.step, self.gaussians, self.config.sh_degree_at(self.step))
            if self.config.stop_overfitting:
                self._overfitting.after_step(
                    self.step, self.gaussians, self.config.sh_degree_at(self.step), self.left_out
                )
            self._mask_what_moves()
            # In the paper, a step ends with density control. Here, density control runs at the
            # beginning of the next step, so that a scene is never evaluated or saved directly after
            # a change by density control.
            if self.step > 0:
                self._limits.remove(self.step, self.gaussians)
                self.gaussians = self._density.after_step(
                    self.step, self.gaussians, self._optimizer
                )
                self._decay.after_step(self.step, self.gaussians)
                self._limits.limit_scales(self.step, self.gaussians)
            step = min(self.step + self.config.batch, self.schedule.iterations)
            batch = self._queue.take(self.step, step)
            losses = self._runner.run(
                lambda: self._optimize(step, batch),
                step,
                self.gaussians,
                [each.view for each in batch],
                [each.photo for each in batch],
            )
            self.exposure.after_step(step, [each.index for each in batch])
        self.step = step
        self.within_step = False
        return sum(losses) / len(losses)

    def _optimize(self, step: int, batch: Sequence[BatchView]) -> None:
        """Rasterize, compare with the photos, and update the Gaussians."""
        self.exposure.begin_step()
        gradients = batch_gradients(
            self.gaussians,
            batch,
            self._runner,
            self.shards,
            self.config.sh_degree_at(step),
            self.exposure,
            self._loss,
        )
        for gradient in gradients:
            self._density.after_backward(step, self.gaussians, gradient)
        self.poses.after_backward(step, self.gaussians, [each.index for each in batch], gradients)
        self._optimizer.step(self.gaussians, gradients, step)

    def _loss(self, image: Tensor, view: BatchView) -> Tensor:
        assert view.photo is not None
        photo = self.transients.masked(view.index, view.photo)
        image = self.exposure.exposed(image, photo, view.index)
        return view_loss(image, photo, view.background, self.config.ssim_weight)

    def evaluate(self) -> Evaluation:
        """Metrics of the test views in the current state. Black replaces a random background."""
        background = self._background.evaluation.tolist()
        with single_threaded():
            return evaluate_views(
                self.gaussians,
                self.poses.test_views(),
                background=background,
                render=self._render,
            )

    def _mask_what_moves(self) -> None:
        settings = self.config.sh_degree_at(self.step), self._downscale(self.step)
        if self.transients.after_step(self.step, self.gaussians, *settings, self.left_out):
            self._queue.continue_with(self._queue.order, self.step)

    def _leave_out_unexplained(self) -> None:
        """Decide once, after the step of ``leave_out_after``, which views are used from now on."""
        after = self.config.leave_out_after
        if self._checked or not after or self.step < self.schedule.step_of(after):
            return
        left_out = unexplained_views(
            self.gaussians,
            self.poses.views(),
            self._images,
            background=self._background.evaluation,
            sh_degree=self.config.sh_degree_at(self.step),
            render=self._render,
        )
        self._checked = True
        self._queue.leave_out(left_out, self.step)

    def _downscale(self, step: int) -> int:
        return self.config.downscale_at(step, self.schedule)

    def state_tensors(self) -> dict[str, Tensor]:
        """The state on which the next steps depend, besides dataset, configuration and schedule.

        The tensors are not copied. With several processes, process 0 gets the rows of all of them;
        the others get no rows.
        """
        return self.shards.collected(self._shard_tensors()) | self._common_tensors()

    def _shard_tensors(self) -> dict[str, Tensor]:
        """The part of the state with one row for each Gaussian of this process."""
        parts = {
            "gaussians": self.gaussians.parameters(),
            "optimizer": self._optimizer.state_tensors(),
            "density": self._density.state_tensors(),
        }
        return {f"{part}.{key}": t for part, named in parts.items() for key, t in named.items()}

    def _common_tensors(self) -> dict[str, Tensor]:
        """The other part of the state, which is the same in all processes."""
        tensors = {f"random.{name}": g.get_state() for name, g in self._generators.items()}
        order = torch.tensor(self._queue.order, dtype=torch.int64)
        tensors |= {"step": torch.tensor(self.step), "order": order}
        if self.config.leave_out_after:  # otherwise, as in earlier versions of the format
            tensors["checked"] = torch.tensor(self._checked)
            tensors["left_out"] = torch.tensor(self.left_out, dtype=torch.int64)
        parts = {
            "exposure": self.exposure.state_tensors(),
            "poses": self.poses.state_tensors(),
        }
        if self.config.transients != "off":
            parts["transients"] = self.transients.state_tensors()
        if self.config.stop_overfitting:
            parts["overfitting"] = self._overfitting.state_tensors()
        for part, state in parts.items():
            tensors |= {f"{part}.{name}": tensor for name, tensor in state.items()}
        return tensors

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy a state of `state_tensors`, from a trainer with the same dataset and configuration.

        Raises:
            UserError: the state has another density control, SH degree or dataset, or is not
                finite.
        """
        own = self._shard_tensors()
        check_state(own, self._common_tensors(), tensors, len(self.dataset.train))
        tensors = tensors | {name: self.shards.own_rows(tensors[name]) for name in own}

        def part(prefix: str) -> dict[str, Tensor]:
            return {n[len(prefix) :]: t for n, t in tensors.items() if n.startswith(prefix)}

        self.gaussians = self.gaussians.with_parameters(part("gaussians.")).clone()
        self.gaussians = self.gaussians.to(self.device)
        self._optimizer.load_state(part("optimizer."))
        self._runner.reset()
        self._density.load_state(part("density."))
        for name, random in self._generators.items():
            try:
                random.set_state(tensors[f"random.{name}"])
            except RuntimeError:  # torch rejects an invalid state
                raise UserError(
                    f"the checkpoint: random state {name!r} is damaged; resume from an earlier one"
                ) from None
        self.step = int(tensors["step"])
        self.within_step = False
        if self.config.leave_out_after:
            self._checked = bool(tensors["checked"])
            self._queue.left_out = tuple(tensors["left_out"].tolist())
        self.exposure.load_state(part("exposure."))
        if self.config.transients != "off":
            self.transients.load_state(part("transients."))
        self.poses.load_state(part("poses."))
        if self.config.stop_overfitting:
            self._overfitting.load_state(part("overfitting."))
        self._queue.continue_with(tensors["order"].tolist(), self.step)
