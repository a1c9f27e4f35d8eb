"""Training: Algorithm 1 of the paper. A `Capture` goes in, `Gaussians` come out."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.dataset import Dataset, View
from snowsplat.data.decode import LoadedImage
from snowsplat.data.image_loader import ImageLoader
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.ops.readback import Readback
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.training import finite as health
from snowsplat.training.config import TrainConfig
from snowsplat.training.init import first_scene
from snowsplat.training.losses import view_loss
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule
from snowsplat.util.errors import UserError
from snowsplat.util.process import interrupts_between_steps, single_threaded

__all__ = ["Progress", "TrainConfig", "Trainer"]

#: Views whose images are decoded ahead of their step.
LOOKAHEAD = 16


@dataclass(frozen=True)
class Progress:
    """What `Trainer.run` reports after each step."""

    step: int
    loss: float
    gaussians: int
    iterations: int
    downscale: int
    metrics: Evaluation | None = None


class Trainer:
    """One training of one dataset.

        trainer = Trainer(dataset, TrainConfig(iterations=7000))
        trainer.run()
        trainer.gaussians

    Between two steps everything is in `state_tensors`: a trainer that loads them goes on bitwise as
    this one would have. Between two steps ``schedule`` may be stretched, too. ``within_step``: an
    error or a second Ctrl-C has ended a step in its middle, and the state is not to be kept.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: TrainConfig,
        schedule: Schedule | None = None,
        device: torch.device | None = None,
    ) -> None:
        """``schedule``: of a training that goes on and was stretched, or ``config.iterations``.
        ``device``: to train on; default: the CPU.

        Raises:
            UserError: a dataset without training views, or with points that lead nowhere.
        """
        if not dataset.train:
            raise UserError("the dataset has no training views; check its folder and its split")
        self.dataset = dataset
        sizes = sorted(view.camera.width * view.camera.height for view in dataset.train)
        self.config = config = config.capped(sizes[len(sizes) // 2])
        self.schedule = schedule or Schedule(config.iterations)
        self.step = 0
        self.within_step = False
        # One generator for each kind of choice, so that one kind does not disturb another.
        self._generators = {
            name: torch.Generator().manual_seed(4 * config.seed + i)
            for i, name in enumerate(("start", "views", "background", "density"))
        }
        self._order: list[int] = []  # the views to come
        fixed = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}.get(config.background)
        self.device = device or torch.device("cpu")
        self._cameras = [view.camera.to(self.device) for view in dataset.train]
        self._background = None if fixed is None else torch.tensor(fixed, device=self.device)
        self._images = ImageLoader(
            dataset.train,
            background=fixed,
            budget_bytes=config.image_memory or None,
            device=self.device,
        )
        with single_threaded():
            self.gaussians = first_scene(dataset, config, self._generators["start"], self.device)
        self._optimizer = Adam(
            self.gaussians,
            config.learning_rates,
            schedule=self.schedule,
            extent=dataset.extent,
            visible_only=config.visible_only,
        )
        self._density = config.density.control(
            len(self.gaussians),
            schedule=self.schedule,
            extent=dataset.extent,
            random_start=dataset.points is None,
            generator=self._generators["density"],
            device=self.device,
        )
        # The CPU makes the room that it needs; a GPU is told how much there is: a guess at first.
        enough = sys.maxsize if self.device.type == "cpu" else 4 * len(self.gaussians)
        self._capacity = ops.Capacity(enough, torch.zeros(1, dtype=torch.int64, device=self.device))
        self._readback = Readback(2 + len(self._optimizer.nonfinite_rows), self.device)

    def run(
        self, on_progress: Callable[[Progress], None] | None = None, until: int | None = None
    ) -> None:
        """Step on to step ``until`` (default: the last one), with a report after each.

        Raises:
            KeyboardInterrupt: Ctrl-C, after the step that it fell into: the state is whole. The
                second one comes at once: see ``within_step``.
            Diverged: loss, gradients or parameters are no longer finite; the step is named.
        """
        last = math.inf if until is None else until
        with interrupts_between_steps() as let_interrupt:
            while self.step < min(last, self.schedule.iterations):
                loss = self.step_once()
                metrics = self.evaluate() if self.step in self.config.test_iterations else None
                if on_progress is not None:
                    iterations, downscale = self.schedule.iterations, self._downscale(self.step)
                    count = len(self.gaussians)
                    on_progress(Progress(self.step, loss, count, iterations, downscale, metrics))
                let_interrupt()
        health.check_updates(self.step, self._optimizer.nonfinite_rows.tolist(), self.gaussians)

    @torch.no_grad()
    def step_once(self) -> float:
        """One iteration of Algorithm 1; gives its loss.

        Raises:
            Diverged: the loss is not finite, or the update of the step before was not.
        """
        self.within_step = True
        with single_threaded():
            # The refinement that ends an iteration of the paper waits for the next one to begin, so
            # that nothing evaluates or saves a scene that was cloned or reset a moment ago.
            if self.step > 0:
                self.gaussians = self._density.after_step(
                    self.step, self.gaussians, self._optimizer
                )
            step = self.step + 1
            view, camera, photo = self._next_view(step)
            background = self._background
            if background is None:
                background = torch.rand(3, generator=self._generators["background"])
                background = background.to(self.device, non_blocking=True)
            while True:
                self._queue_step(step, camera, photo, background)
                # All of the step is queued by now: a GPU works on it while this waits for the loss.
                loss, required, *nonfinite_rows = self._readback.wait()
                enough = required <= self._capacity.instances
                if required > 0.9 * self._capacity.instances:
                    self._capacity = replace(self._capacity, instances=int(1.3 * required))
                if enough:
                    break
            health.check_updates(
                self.step, nonfinite_rows, self.gaussians
            )  # on a GPU, a step later
            health.check_loss(step, loss, self.gaussians, view, photo)
            self.step = step
            self.within_step = False
            return loss

    def _queue_step(
        self, step: int, camera: Camera, photo: LoadedImage, background: Tensor
    ) -> None:
        """One iteration, from the splats to the new parameters; nothing here waits for a GPU.

        Nothing changes where ``valid`` is False; `_readback` tells why.
        """
        sh_degree = self.config.sh_degree_at(step)
        splats = project(self.gaussians, camera, sh_degree)
        size = camera.width, camera.height
        with torch.enable_grad():  # of the splats; the optimiser carries it on to the Gaussians
            splats.packed.requires_grad_()
            image, _, _ = ops.rasterize(splats, *size, background, capacity=self._capacity)
            loss = view_loss(image, photo, background, self.config.ssim_weight)
            self._readback.start(loss, self._capacity.required, self._optimizer.nonfinite_rows)
            valid = loss.detach().isfinite() & (self._capacity.required <= self._capacity.instances)
            valid &= ~self._optimizer.nonfinite_rows.any()
            loss.backward()
        self._density.after_backward(step, self.gaussians, splats, *size, valid)
        self._optimizer.step(self.gaussians, splats, camera, sh_degree, step, valid)

    def evaluate(self) -> Evaluation:
        """Figures of the test views as the scene is now; a random background counts as black."""
        background = (0.0, 0.0, 0.0) if self._background is None else self._background.tolist()
        with single_threaded():
            return evaluate_views(self.gaussians, self.dataset.test, background=background)

    def _next_view(self, step: int) -> tuple[View, Camera, LoadedImage]:
        """The next of endlessly shuffled views; its camera and photo at this step's resolution."""
        downscale = self._downscale(step)
        if len(self._order) <= LOOKAHEAD:
            while len(self._order) <= LOOKAHEAD:
                count = len(self.dataset.train)
                self._order += torch.randperm(count, generator=self._generators["views"]).tolist()
            self._prefetch(downscale)
        elif downscale != self._downscale(step - 1):
            self._prefetch(downscale)
        i = self._order.pop(0)
        view, camera = self.dataset.train[i], self._cameras[i].downscaled(downscale)
        return view, camera, self._images.get(view, downscale)

    def _downscale(self, step: int) -> int:
        return self.config.downscale_at(step, self.schedule)

    def _prefetch(self, downscale: int) -> None:
        self._images.prefetch([self.dataset.train[i] for i in self._order], downscale)

    def state_tensors(self) -> dict[str, Tensor]:
        """All that the steps to come depend on, beside dataset, config, schedule. Not copied."""
        parts = {
            "gaussians": self.gaussians.parameters(),
            "optimizer": self._optimizer.state_tensors(),
            "density": self._density.state_tensors(),
            "random": {name: random.get_state() for name, random in self._generators.items()},
        }
        tensors = {f"{part}.{key}": t for part, of in parts.items() for key, t in of.items()}
        order = torch.tensor(self._order, dtype=torch.int64)
        return tensors | {"step": torch.tensor(self.step), "order": order}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over (copy) what `state_tensors` gave in a trainer whose dataset, config and
        schedule are equal.

        Raises:
            UserError: it is of another density control, SH degree or dataset, or not finite.
        """
        health.check_state(self.state_tensors(), tensors, len(self.dataset.train))

        def part(of: str) -> dict[str, Tensor]:
            return {n[len(of) :]: t for n, t in tensors.items() if n.startswith(of)}

        self.gaussians = Gaussians(**part("gaussians.")).clone().to(self.device)
        self._optimizer.load_state(part("optimizer."))
        self._density.load_state(part("density."))
        for name, random in self._generators.items():
            try:
                random.set_state(tensors[f"random.{name}"])
            except RuntimeError:  # torch knows what can be one
                raise UserError("the checkpoint is damaged; go on from an earlier one") from None
        self.step = int(tensors["step"])
        self.within_step = False
        self._order = tensors["order"].tolist()
        self._prefetch(self._downscale(self.step + 1))
