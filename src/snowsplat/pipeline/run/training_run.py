"""`TrainingRun`: runs the steps of one training run and writes its files."""

import logging
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from snowsplat.data import Dataset, read_dataset
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.evaluation.verdict import Verdict
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.dataset_check import Stamp
from snowsplat.pipeline.run.live_page import LivePage, Watchers
from snowsplat.pipeline.run.processes import Collective
from snowsplat.pipeline.run.results import TrainingStopped, TrainResult
from snowsplat.pipeline.run.training_files import (
    CheckpointMeta,
    write_beginning,
    write_cameras,
    write_refined,
    write_scene,
)
from snowsplat.project.left_out import LeftOut
from snowsplat.project.project import Project
from snowsplat.project.training_folder import UNEXPLAINED, DatasetSettings, TrainingFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.sfm.report.capture_verdict import recorded_verdict
from snowsplat.training.budgets.memory_budget import MemoryPlan
from snowsplat.training.budgets.pace import Pace, TimeBudget
from snowsplat.training.core import checkpoint
from snowsplat.training.core.history import History
from snowsplat.training.core.run import Loss
from snowsplat.training.core.trainer import Progress, Trainer
from snowsplat.training.parts.part import Part, PartReport
from snowsplat.training.report import Trained, write_training_report
from snowsplat.training.report.scene_verdict import scene_verdict
from snowsplat.training.settings.stored import config_to_json
from snowsplat.training.step.finite import Diverged
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.machine import peak_bytes
from snowsplat.util.messages import Message, message
from snowsplat.util.process import single_threaded

logger = logging.getLogger(__name__)

#: Number of training views with which the held-out ones are compared.
_TRAINING_VIEWS = 4


@dataclass(frozen=True)
class Request:
    """What the caller of `train` or `resume` has given."""

    out: TrainingFolder
    options: TrainOptions
    observer: Observer
    page: LivePage | None = None  # shows the training in the browser
    parts: Sequence[Part] = ()
    loss: Loss | None = None
    started: float = field(default_factory=time.monotonic)


@dataclass
class TrainingRun:
    """One training run, to its end or to Ctrl-C."""

    request: Request
    # settings, recipe: how the dataset was read, and the recipe; written to checkpoints.
    settings: DatasetSettings
    recipe: str
    trainer: Trainer
    memory: MemoryPlan
    memory_before: int  # see `MemoryPlan.peak`
    budget: TimeBudget | None  # None: no time budget
    pace: Pace
    doubts: tuple[Message, ...] = ()  # what is doubtful about the dataset, for the report
    photos: dict[str, Stamp] | None = None  # stamps of the photos and masks, for checkpoints

    def __post_init__(self) -> None:
        self.out, self.observer = self.request.out, self.request.observer
        self.config = self.trainer.config
        self.first_step = self.trainer.step
        self.started = self.last_checkpoint = time.monotonic()
        self.evaluation: tuple[int, Evaluation] | None = None  # the last one and its step
        self.history = History.read(self.out.history, self.first_step)
        self.together = Collective(self.trainer)
        self.watchers = Watchers(self.out.path, self.trainer, self.request.page)

    def run(self) -> TrainResult:
        """Run all steps and write the results.

        Raises:
            UserError: the loss, gradients or parameters are not finite.
            TrainingStopped: Ctrl-C; the attributes of the exception say what was saved.
            KeyboardInterrupt: Ctrl-C before the first step was finished; no files remain.
        """
        try:
            with self.observer.stepping(self.first_step, self.trainer.schedule.iterations):
                self._finish_interrupted_writes()
                self.together.proceed()
                self.history.step_begins()
                with self.watchers:
                    self.trainer.run(self._record)
        except KeyboardInterrupt:
            if self.trainer.step == 0 or self.trainer.within_step:  # no complete state to save
                self.out.discard()
                if self.trainer.step == 0:
                    raise
                last = self._last_checkpoint_as_text()
                stopped = message("stopped within a step, which is not saved; {last}", last=last)
                raise TrainingStopped(str(stopped), None) from None
        except Diverged as error:
            self.out.discard()
            last = self._last_checkpoint_as_text()
            raise UserError("{error}; {last}", error=error, last=last) from None
        except BaseException:
            self.out.discard()
            raise
        else:
            result = self._finish()
            self.together.proceed()
            return result
        scene = self._save_scene()
        self._save_checkpoint()
        self.together.proceed()
        stopped = message("stopped after step {step}: {scene}", step=self.trainer.step, scene=scene)
        raise TrainingStopped(str(stopped), scene)

    def _record(self, progress: Progress) -> None:
        # If there are metrics, the time of the step includes an evaluation and is not counted.
        timed = progress.metrics is None
        self.history.step_ends(progress.step, progress.loss, progress.gaussians, timed=timed)
        if progress.metrics is not None:
            self._record_evaluation(progress.step, progress.metrics)
        schedule, step = self.trainer.schedule, progress.step
        length = self.pace.after_step(schedule, step, progress.downscale, progress.gaussians)
        self.observer.step(replace(progress, seconds_left=self.pace.seconds_left))
        if self._checkpoint_is_due(step):
            self._save_checkpoint()
        if schedule.contains(step, self.request.options.save_iterations):
            self._save_scene()
        paused = self.watchers.after_step(
            step, progress.iterations, progress.loss, self.trainer.gaussians
        )
        if paused:
            self.pace.postpone(paused)
            if self.budget is not None:
                self.budget.started += paused
        if length is not None:
            self.together.stretch(step, length)
        self.together.proceed()
        self.history.step_begins()

    def _left_out(self) -> tuple[LeftOut, ...]:
        views = self.trainer.dataset.train
        return (
            *self.settings.unused(),
            *(LeftOut(views[i].name, "training", UNEXPLAINED) for i in self.trainer.excluded),
        )

    def _checkpoint_is_due(self, step: int) -> bool:
        every, seconds = self.config.checkpoint_every, self.request.options.checkpoint_seconds
        if every:
            return self.trainer.schedule.multiples(step, every) > 0
        return seconds is not None and time.monotonic() - self.last_checkpoint > seconds

    def _finish_interrupted_writes(self) -> None:
        """Complete the work of an earlier run that was killed directly after saving a checkpoint.

        Remove old checkpoints, and save the scene if it was requested for this step.
        """
        step = self.first_step
        checkpoint.remove_old(self.out.checkpoints, step)
        due = step > 0 and self.trainer.schedule.contains(
            step, self.request.options.save_iterations
        )
        if due and step not in self.out.scenes():
            self._save_scene()

    def _save_scene(self) -> Path:
        return self._write_scene(self.together.scene())

    def _write_scene(self, gaussians: Gaussians) -> Path:
        self._restore_folder()
        cameras = self.trainer.cameras
        if self.trainer.refines_cameras:
            views = [*cameras.views(), *cameras.test_views()]
            write_cameras(self.out, views)
            write_refined(self.out, views, read_dataset(replace(self.settings, resolution=-1)))
        return write_scene(self.out, self.trainer.step, gaussians)

    def _restore_folder(self) -> None:
        """Create the folder again if it was moved or removed, so that the training is not lost."""
        if not self.out.is_training():
            warnings.warn(f"{self.out.path}: was removed; it is created again", stacklevel=2)
            write_beginning(self.out, self.trainer.dataset, self.settings, self.config)

    def _save_checkpoint(self) -> Path:
        self._restore_folder()
        training = config_to_json(self.config)
        meta = CheckpointMeta(self.settings, self.recipe, training, photos=self.photos)
        if self.budget is not None:
            meta = replace(meta, time=self.budget.as_json())
        if self.trainer.schedule.since > 0:
            meta = replace(meta, schedule=self.trainer.schedule)
        # Write the history first: a run that resumes from the checkpoint needs the curves up to it.
        self.history.write(self.out.history)
        path = checkpoint.save(
            self.out.checkpoints, self.trainer.step, self.together.state(), meta.as_json()
        )
        self.last_checkpoint = time.monotonic()
        return path

    def _last_checkpoint_as_text(self) -> Message:
        """Which checkpoint can be used, as the end of an error message."""
        saved = checkpoint.files(self.out.checkpoints)
        if not saved:
            return message("there is no checkpoint yet")
        step, path = saved[0]
        return message(
            "the last good checkpoint is {path}; use `resume` with `iterations` {step} to save its "
            "scene",
            path=path,
            step=step,
        )

    def _record_evaluation(self, step: int, evaluation: Evaluation) -> None:
        if evaluation.views:
            self.evaluation = (step, evaluation)
            self.history.measure(step, evaluation.psnr, evaluation.ssim)
        elif evaluation.unjudged:
            logger.warning("held-out photos are %s", evaluation.line_of_unjudged())

    def _finish(self) -> TrainResult:
        step = self.trainer.step
        gaussians = self.together.scene()
        scene = self._write_scene(gaussians)
        seconds = time.monotonic() - self.started
        memory = self.memory.peak(self.memory_before)
        measured = self.evaluation is not None and self.evaluation[0] == step
        if self.trainer.dataset.test and not measured:
            self._record_evaluation(step, self.together.evaluate())
        if self.evaluation is not None:
            self.out.write_metrics(step, "test", self.evaluation[1].as_json(), self._left_out())
        if (page := self.request.page) is not None and page.training is not None:
            page.training.end(self._result_lines(len(gaussians), seconds))
        self.history.write(self.out.history)
        reports = {part.name: part.report(self.trainer, gaussians) for part in self.trainer.parts}
        for each in reports.values():
            self.out.write_files(each.files)
        verdict = self._verdict(gaussians, list(reports.values()))
        report = self._write_report(gaussians, list(reports.values()), verdict)
        time_used = None
        if self.budget is not None:
            longer = config_to_json(replace(self.config, iterations=step))
            self.out.write_settings(self.settings, longer)
            time_used = self.budget.as_json()["spent"], self.budget.seconds
        result = TrainResult(
            scene=scene,
            report=report,
            step=step,
            first_step=self.first_step,
            gaussians=len(gaussians),
            seconds=seconds,
            memory=memory,
            reductions=self.memory.reductions,
            evaluation=self.evaluation,
            left_out=self._left_out(),
            parts=reports,
            verdict=verdict,
            time=time_used,
        )
        self.observer.trained(result)
        return result

    def _result_lines(self, gaussians: int, seconds: float) -> list[Message]:
        steps, time = self.trainer.step, duration(seconds)
        lines = [
            message("Finished: {steps:,} steps in {time}", steps=steps, time=time),
            message("{gaussians:,} Gaussians", gaussians=gaussians),
        ]
        if self.evaluation is not None:
            psnr, views = self.evaluation[1].psnr, len(self.evaluation[1].views)
            lines.append(
                message("PSNR {psnr:.2f} dB, {views} held-out photos", psnr=psnr, views=views)
            )
        return lines

    def _verdict(self, gaussians: Gaussians, reports: Sequence[PartReport]) -> Verdict | None:
        """The verdict on the scene; see `TrainResult.verdict`."""
        if self.evaluation is None:
            return None
        dataset = self._dataset()
        used = [view for i, view in enumerate(dataset.train) if i not in self.trainer.excluded]
        with single_threaded():
            trained_on = evaluate_views(
                gaussians,
                used[:: -(-len(used) // _TRAINING_VIEWS)],
                background=self.out.settings()[1],
            )
        if not trained_on.views:
            return None
        return scene_verdict(
            self.evaluation[1],
            trained_on,
            dataset,
            [reason for each in reports for reason in each.reasons],
            capture=recorded_verdict(Path(self.settings.path)),
        )

    def _dataset(self) -> Dataset:
        """The dataset with the present cameras."""
        cameras = self.trainer.cameras
        return replace(self.trainer.dataset, train=cameras.views(), test=cameras.test_views())

    def _write_report(
        self, gaussians: Gaussians, reports: Sequence[PartReport], verdict: Verdict | None
    ) -> Path:
        # Users may share the report, so it contains names of files but no paths.
        project = Project.open(self.out.path)
        folder = project.home
        dataset = asdict(self.settings)
        for key in ("path", "test_list"):
            dataset[key] = dataset[key] and Path(dataset[key]).name
        write_training_report(
            self.out.report,
            Trained(
                name=project.name,
                folder=folder.resolve().name if folder.is_absolute() else str(folder),
                dataset=self._dataset(),
                gaussians=gaussians,
                step=self.trainer.step,
                background=self.out.settings()[1],
                history=self.history,
                evaluation=None if self.evaluation is None else self.evaluation[1],
                left_out=tuple(each.photo for each in self._left_out()),
                parts=reports,
                doubts=self.doubts,
                verdict=verdict,
                settings={
                    "recipe": self.recipe,
                    "dataset": dataset,
                    "training": config_to_json(self.config),
                },
                peak_bytes=peak_bytes(),
                of_make=folder != self.out.path,
            ),
        )
        return self.out.report
