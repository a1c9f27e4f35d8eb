"""`Observer`: receives the progress of the functions of this package.

`CsvLog` and `TensorBoardLog` write the figures of a training for other programs. Both continue the
log of an interrupted training: what it wrote after its checkpoint is replaced.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from snowsplat.sfm.progress import Report, silent
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.pipeline.run.results import TrainResult
    from snowsplat.project.training_folder import TrainingFolder
    from snowsplat.sfm.report.scene_map import PlacedPhoto
    from snowsplat.training.core.trainer import Progress
    from snowsplat.util.stages import Outcome

#: The columns of `CsvLog`. The last three are those of the held-out photos, in dB, after an
#: evaluation; that of the last step has a row of its own.
COLUMNS = ("step", "loss", "gaussians", "seconds", "psnr", "ssim", "lpips")


class Page(Protocol):
    """A page in the browser: its address, and those for other computers if they differ."""

    @property
    def url(self) -> str: ...

    @property
    def others(self) -> list[str]: ...


class Observer:
    """The base class of observers. Its methods do nothing; a subclass overrides those it needs.

    A job such as `make` consists of stages. `begin` and `end` are called for each stage. The
    training also reports its steps.
    """

    def note(self, line: Message) -> None:
        """A line of information for the user."""

    def inform(self, key: str, /, **values: Any) -> None:
        """`note` a message with values; see `message`."""
        self.note(message(key, **values))

    def begin(self, stage: str) -> Report:
        """Called for every stage, also if an earlier run has finished it.

        Returns the progress callback of the stage.
        """
        return silent

    def end(self, stage: str, outcome: Outcome) -> None:
        """The stage has finished, now or in an earlier run."""

    def show_poses(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None:
        """Photos have a pose; see `snowsplat.sfm.progress.ShowPoses`."""

    def leave(self) -> None:
        """The stage that began last is over; there is nothing to tell about it."""

    @contextmanager
    def waiting(self, stage: str) -> Iterator[Report]:
        """A context of a stage that may take a while and has no outcome; its progress callback."""
        try:
            yield self.begin(stage)
        finally:
            self.leave()

    def steps_begin(self, step: int, iterations: int) -> None:
        """A training run begins after ``step`` of ``iterations`` steps."""

    def step(self, progress: Progress) -> None:
        """A training step is finished."""

    def steps_end(self) -> None:
        """The last step is finished, or the training was interrupted."""

    @contextmanager
    def stepping(self, step: int, iterations: int) -> Iterator[None]:
        """A context of the steps of a training run; see `steps_begin` and `steps_end`."""
        self.steps_begin(step, iterations)
        try:
            yield
        finally:
            self.steps_end()

    def trained(self, result: TrainResult) -> None:
        """The training has finished; its files are written."""

    def page_opened(self, page: Page) -> None:
        """A page shows the scene in the browser at ``page.url``."""


class Observers(Observer):
    """Passes everything on to several observers."""

    def __init__(self, *observers: Observer) -> None:
        self.all = observers

    def begin(self, stage: str) -> Report:
        reports = [each.begin(stage) for each in self.all]

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            for each in reports:
                each(done, total, what, left)

        return report


def _passed_on(name: str) -> Callable[..., None]:
    def call(observers: Observers, *arguments: object) -> None:
        for each in observers.all:
            getattr(each, name)(*arguments)

    return call


for _name in (
    *("note", "end", "show_poses", "leave", "page_opened"),
    *("steps_begin", "step", "steps_end", "trained"),
):
    setattr(Observers, _name, _passed_on(_name))

#: An observer that does nothing.
SILENT = Observer()


class _StepLog(Observer):
    """Writes the figures of each step, and of each evaluation once."""

    def __init__(self) -> None:
        self._evaluated = -1  # the last step with an evaluation

    def steps_begin(self, step: int, iterations: int) -> None:
        self._first, self._started = step, time.monotonic()
        self._is_open = False

    def step(self, progress: Progress) -> None:
        if not self._is_open:  # not earlier: nothing remains of a training without a step
            self._is_open = True
            self._open(self._first)
        figures = {"loss": progress.loss, "gaussians": progress.gaussians}
        self._write(progress.step, figures | self._of(progress.step, progress.metrics))

    def steps_end(self) -> None:
        if self._is_open:
            self._close()

    def trained(self, result: TrainResult) -> None:
        step, evaluation = result.evaluation or (-1, None)
        if step > self._evaluated and self._is_open:
            self._open(step)
            self._write(step, {"gaussians": result.gaussians} | self._of(step, evaluation))
            self._close()

    def _of(self, step: int, evaluation: Evaluation | None) -> dict[str, float]:
        if evaluation is None or not evaluation.views:
            return {}
        self._evaluated = step
        figures = {"psnr": evaluation.psnr, "ssim": evaluation.ssim}
        return figures if evaluation.lpips is None else figures | {"lpips": evaluation.lpips}

    def _open(self, step: int) -> None:
        """Open the log, and remove what is later than ``step``."""
        raise NotImplementedError

    def _write(self, step: int, figures: dict[str, float]) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        raise NotImplementedError


class CsvLog(_StepLog):
    """A CSV file with a row for each step; ``seconds`` is the time of all steps so far."""

    def __init__(self, path: Path | str) -> None:
        super().__init__()
        self._path = Path(path)

    def _open(self, step: int) -> None:
        rows = []
        if step and self._path.is_file():
            with self._path.open(encoding="utf-8", newline="") as file:
                rows = [row for row in csv.reader(file) if len(row) == len(COLUMNS)]
        rows = [row for row in rows if row[0].isdigit() and int(row[0]) <= step]
        last = rows[-1][3] if rows else ""
        self._before = float(last) if last.replace(".", "", 1).isdecimal() else 0.0
        with atomic_path(self._path) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
        # Lines are written at once, so that a killed training loses none.
        self._file = self._path.open("a", encoding="utf-8", newline="", buffering=1)
        self._rows = csv.DictWriter(self._file, COLUMNS)

    def _write(self, step: int, figures: dict[str, float]) -> None:
        seconds = self._before
        if "loss" in figures:
            seconds += time.monotonic() - self._started
        self._rows.writerow({"step": step, "seconds": f"{seconds:.3f}"} | figures)

    def _close(self) -> None:
        self._file.close()


class TensorBoardLog(_StepLog):
    """A folder for TensorBoard. Raises: UserError: TensorBoard is not installed."""

    def __init__(self, folder: Path | str) -> None:
        super().__init__()
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise UserError(
                "TensorBoard is not installed; pip install 'snowsplat[tensorboard]', or log as CSV"
            ) from None
        self._folder, self._made = str(folder), SummaryWriter
        self._writer: Any = None

    def _open(self, step: int) -> None:
        self._writer = self._made(self._folder, purge_step=step + 1 if step else None)

    def _write(self, step: int, figures: dict[str, float]) -> None:
        for name, value in figures.items():
            self._writer.add_scalar(name, value, step)

    def _close(self) -> None:
        self._writer.close()


#: The names of the logs -> what makes them in an output folder.
LOGS: dict[str, Callable[[TrainingFolder], Observer]] = {
    "csv": lambda out: CsvLog(out.csv_log),
    "tensorboard": lambda out: TensorBoardLog(out.tensorboard),
}
