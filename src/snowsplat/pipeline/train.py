"""The steps of one training and what is written on the way: the work of `snowsplat train`."""

from __future__ import annotations

import time
import warnings
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.cli.progress import TrainingProgress, duration, held_out_line, peak_bytes
from snowsplat.pipeline.memory import MemoryBudget
from snowsplat.pipeline.output_folder import DatasetSettings, OutputFolder
from snowsplat.pipeline.timed import TimeBudget
from snowsplat.training.history import History
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.training.time_budget.pace import Pace
    from snowsplat.training.trainer import Progress, Trainer
    from snowsplat.viewer.live.training import TrainingViewer


@dataclass
class TrainingRun:
    """One training, to its end or to Ctrl-C.

    Attributes:
        settings, recipe: as they are written down.
        budget, pace: of a training with a time.
        memory: what it takes, and may take.
        save_iterations: steps after which the scene is written too.
        checkpoint_seconds: between checkpoints, where the configuration names no steps.
        again: the command that goes on where Ctrl-C stopped.
        viewer: the page that shows it.
    """

    out: OutputFolder
    settings: DatasetSettings
    recipe: str
    trainer: Trainer
    budget: TimeBudget | None
    pace: Pace | None
    memory: MemoryBudget
    save_iterations: tuple[int, ...] = ()
    checkpoint_seconds: float | None = None
    again: str = ""
    quiet: bool = False
    viewer: TrainingViewer | None = None

    def __post_init__(self) -> None:
        self.config = self.trainer.config
        self.first_step = self.trainer.step
        self.progress = TrainingProgress(self.trainer.schedule.iterations, self.trainer.step)
        self.last_checkpoint = time.monotonic()
        self.evaluation: tuple[int, Evaluation] | None = None  # the newest, and its step
        self.history = History.read(self.out.history, self.first_step)

    def run(self) -> int:
        """Gives the exit code: 0, or 130 after Ctrl-C.

        Raises:
            UserError: the training came to numbers that are not finite.
        """
        from snowsplat.training.finite import Diverged

        stopped = False
        try:
            with nullcontext() if self.quiet else self.progress:
                self._do_what_a_kill_prevented()
                self.history.step_begins()
                self.trainer.run(self._record)
        except KeyboardInterrupt:
            if self.trainer.step == 0 or self.trainer.within_step:  # there is nothing whole to save
                if self.trainer.step > 0:
                    print(f"stopped within a step, which is not saved; {self._kept()}")
                self.out.discard()
                raise
            stopped = True
        except Diverged as error:
            self.out.discard()
            raise UserError(f"{error}; {self._kept()}") from None
        except BaseException:
            self.out.discard()
            raise
        return self._stopped() if stopped else self._finished()

    def _record(self, progress: Progress) -> None:
        measured = progress.metrics is not None  # within the step, as it seems from here
        self.history.step_ends(progress.step, progress.loss, progress.gaussians, timed=not measured)
        self._after_step(progress)
        self.history.step_begins()

    def _after_step(self, progress: Progress) -> None:
        if progress.metrics is not None and progress.metrics.views:
            self._measured(progress.step, progress.metrics)
        if not self.quiet:
            self.progress(progress)
        if self._checkpoint_is_due(progress.step):
            self._save_checkpoint()
        if progress.step in self.save_iterations:
            self._save_scene()
        if self.viewer is not None:
            paused = self.viewer.after_step(
                progress.step, progress.iterations, progress.loss, self.trainer.gaussians
            )
            if self.pace is not None and self.budget is not None:
                self.pace.put_off(paused)
                self.budget.started += paused
        if self.pace is not None:
            schedule = self.trainer.schedule
            length = self.pace.iterations_after(
                schedule, progress.step, progress.downscale, progress.gaussians
            )
            if length is not None:
                schedule.stretch(progress.step, length)

    def _checkpoint_is_due(self, step: int) -> bool:
        every, seconds = self.config.checkpoint_every, self.checkpoint_seconds
        if every:
            return step % every == 0
        return seconds is not None and time.monotonic() - self.last_checkpoint > seconds

    def _do_what_a_kill_prevented(self) -> None:
        """Between a checkpoint and the removal of an old one, or the scene of the same step."""
        from snowsplat.training import checkpoint

        step = self.first_step
        checkpoint.remove_old(self.out.checkpoints, step)
        if step in self.save_iterations and step not in self.out.scenes():
            self._save_scene()

    def _save_scene(self) -> Path:
        self._look_for_the_folder()
        return self.out.write_scene(self.trainer.step, self.trainer.gaussians)

    def _look_for_the_folder(self) -> None:
        """Hours of training are not lost because somebody moved or removed it."""
        if not self.out.is_one():
            warnings.warn(f"{self.out.path}: is gone; it is made anew, to go on in", stacklevel=2)
            self.out.describe(self.trainer.dataset, self.settings, self.config)

    def _save_checkpoint(self) -> Path:
        from snowsplat.training import checkpoint
        from snowsplat.training.config import config_to_json

        self._look_for_the_folder()
        meta = {
            "capture": asdict(self.settings),
            "recipe": self.recipe,
            "training": config_to_json(self.config),
        }
        if self.budget is not None:
            meta["time"] = self.budget.as_json()
            meta["schedule"] = asdict(self.trainer.schedule)
        self.history.write(self.out.history)  # first: who goes on from there finds it whole
        path = checkpoint.save(
            self.out.checkpoints, self.trainer.step, self.trainer.state_tensors(), meta
        )
        self.last_checkpoint = time.monotonic()
        return path

    def _kept(self) -> str:
        from snowsplat.training import checkpoint

        kept = checkpoint.files(self.out.checkpoints)
        if not kept:
            return "there is no checkpoint yet"
        step, path = kept[0]
        return f"the last good checkpoint is {path}, --resume --iterations {step} makes it a scene"

    def _measured(self, step: int, evaluation: Evaluation) -> None:
        self.evaluation = (step, evaluation)
        self.history.measure(step, evaluation.psnr, evaluation.ssim)

    def _stopped(self) -> int:
        path = self._save_scene()
        self._save_checkpoint()
        print(f"stopped after step {self.trainer.step}: {path}")
        print(f"go on with: {self.again}")
        return 130

    def _finished(self) -> int:
        step = self.trainer.step
        path = self._save_scene()
        steps = f"{step - self.first_step} more steps" if self.first_step else f"{step} steps"
        print(
            f"{path}: {len(self.trainer.gaussians):,} Gaussians, {steps} in "
            f"{duration(self.progress.seconds)}, {self.memory.taken()}"
        )
        for line in self.memory.plan.given_up:
            print(f"for lack of memory: {line}")
        if self.trainer.dataset.test:
            if self.evaluation is None or self.evaluation[0] != step:
                self._measured(step, self.trainer.evaluate())
            assert self.evaluation is not None
            self.out.write_metrics(step, "test", self.evaluation[1])
        self.history.write(self.out.history)
        print(f"{self._write_report()}: how it went")
        if self.evaluation is not None:
            print(held_out_line(*self.evaluation))
        if self.budget is not None:
            self.out.write_config(self.settings, replace(self.config, iterations=step))
            spent = self.budget.as_json()["spent"]
            print(f"{duration(spent)} in all, of {duration(self.budget.seconds)}")
        return 0

    def _write_report(self) -> Path:
        from snowsplat.training.config import config_to_json
        from snowsplat.training.report import Trained, write_training_report

        # The page may be given away: of paths it tells no more than names.
        out = self.out.path
        dataset = asdict(self.settings)
        for word in ("path", "test_list"):
            dataset[word] = dataset[word] and Path(dataset[word]).name
        write_training_report(
            self.out.report,
            Trained(
                name=out.resolve().name if out.is_absolute() else str(out),
                dataset=self.trainer.dataset,
                gaussians=self.trainer.gaussians,
                step=self.trainer.step,
                background=self.out.settings()[1],
                history=self.history,
                evaluation=None if self.evaluation is None else self.evaluation[1],
                settings={
                    "recipe": self.recipe,
                    "capture": dataset,
                    "training": config_to_json(self.config),
                },
                peak_bytes=peak_bytes(),
            ),
        )
        return self.out.report
