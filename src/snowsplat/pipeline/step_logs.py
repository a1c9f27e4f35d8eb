"""Observers that write the figures of a training for other programs: `CsvLog`, `TensorBoardLog`.

Both continue the log of an interrupted training: what it wrote after its checkpoint is replaced.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.pipeline.observer import Observer
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.pipeline.run.results import TrainResult
    from snowsplat.training.core.progress import Progress

#: The columns of `CsvLog`. The last three are those of the held-out photos, in dB, after an
#: evaluation; that of the last step has a row of its own.
COLUMNS = ("step", "loss", "gaussians", "seconds", "psnr", "ssim", "lpips")


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
