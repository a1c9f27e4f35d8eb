"""`Trainer`: Algorithm 1 of the paper. It creates `Gaussians` from a `Dataset`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.data.photos.decode import LoadedImage
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.scene.render import RenderOutput
from snowsplat.training.core.run import Run, add_regularizers
from snowsplat.training.core.view_graphs import Objective
from snowsplat.training.step.batch import Batch, BatchView, batch_gradients
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.interrupts import interrupts_between_steps
from snowsplat.util.process import single_threaded


class Trainer(Run):
    """Trains Gaussians on a dataset.

        trainer = Trainer(dataset, TrainConfig(iterations=7000))
        trainer.run()
        trainer.gaussians

    Between two steps, `state_tensors` is the complete state. A trainer that loads it produces
    bit-identical results (on a GPU: only with `torch.use_deterministic_algorithms`).
    Between two steps, `Schedule.stretch` may change the number of steps.
    """

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
                    iterations, downscale = self.schedule.iterations, self.downscale_at(self.step)
                    count = self.total
                    on_progress(Progress(self.step, loss, count, iterations, downscale, metrics))
                raise_deferred_interrupt(self.shards.any)
        self.runner.finish(self.step, self.gaussians)

    @torch.no_grad()
    def step_once(self) -> float:
        """Run one iteration of Algorithm 1, with one or a batch of views; return the mean loss.

        Raises:
            Diverged: the loss is not finite, or the update of the previous step was not finite.
        """
        self.within_step = True
        with single_threaded():
            # In the paper, a step ends with density control. Here, it is a part that runs at the
            # beginning of the next step, so that a scene is never evaluated or saved directly after
            # a change by density control.
            if self.step > 0:
                for part in self.parts:
                    part.between(self)
                self.count()
            step = min(self.step + self.config.batch, self.schedule.iterations)
            batch = self.queue.take(self.step, step)
            losses = self.runner.run(
                lambda: self._optimize(step, batch),
                step,
                self.gaussians,
                [each.view for each in batch],
                [each.photo for each in batch],
            )
            for part in self.parts:
                part.after_step(self, step, batch)
        self.step = step
        self.within_step = False
        return sum(losses) / len(losses)

    def _optimize(self, step: int, batch: Batch) -> None:
        """Rasterize, compare with the photos, and update the Gaussians."""
        gradients = self._gradients(step, batch)
        for part in reversed(self.parts):
            part.gradients(self, step, batch, gradients)
        add_regularizers(self)
        self.optimizer.step(self.gaussians, gradients, step)

    def _gradients(self, step: int, batch: Batch) -> list[ViewGradient]:
        sh_degree = self.config.sh_degree_at(step)
        # Recordings contain neither `_background` nor `_loss`, which a subclass may replace.
        kind = type(self)
        replaced = kind._background is not Trainer._background or kind._loss is not Trainer._loss
        if self.graphs is not None and not replaced:
            (view,) = batch
            idle = tuple(part.idle for part in self.parts)
            objective = Objective(
                self._background, self._compared, self._repeated, (self.loss, idle)
            )
            recorded = self.graphs.gradient(
                self.gaussians, view, self._target(view), sh_degree, self.runner, objective
            )
            if recorded is not None:
                return [recorded]
        return batch_gradients(
            self.gaussians,
            batch,
            self.runner,
            self.shards,
            sh_degree,
            self._background,
            self._loss,
        )

    def _background(self, view: BatchView) -> Tensor:
        color = view.background
        for part in self.parts:
            color = part.background(self, view, color)
        return color

    def _target(self, view: BatchView) -> LoadedImage:
        photo = view.photo
        assert photo is not None
        for part in self.parts:
            photo = part.target(self, view, photo)
        return photo

    def _loss(self, view: BatchView, rendered: RenderOutput) -> Tensor:
        return self._compared(view, rendered, self._target(view))

    def _compared(self, view: BatchView, rendered: RenderOutput, photo: LoadedImage) -> Tensor:
        """The loss (); ``photo``: from `_target`."""
        image = rendered.image
        for part in self.parts:
            image = part.image(self, view, image, photo)
        loss = self.loss(image, photo, view.background)
        for part in self.parts:
            if (term := part.loss(self, view, rendered)) is not None:
                loss = loss + term
        return loss

    def _repeated(self, view: BatchView, recorded: BatchView) -> None:
        for part in self.parts:
            part.repeated(self, view, recorded)

    def evaluate(self) -> Evaluation:
        """Metrics of the test views in the current state. Black replaces a random background."""
        background = self.background.evaluation.tolist()
        with single_threaded():
            return evaluate_views(
                self.gaussians,
                self.cameras.test_views(),
                background=background,
                render=self.render,
            )


@dataclass(frozen=True)
class Progress:
    """The report of `Trainer.run` after each step.

    ``downscale`` is the factor by which the photos of the step were reduced. ``metrics`` is the
    evaluation of the test views, after the steps of ``test_iterations``; None after other steps.
    ``seconds_left`` is an estimate that `pipeline.run.training_run` adds.
    """

    step: int
    loss: float
    gaussians: int
    iterations: int
    downscale: int
    metrics: Evaluation | None = None
    seconds_left: float | None = None
