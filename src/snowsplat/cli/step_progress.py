"""`StepProgress`: the steps of a training run, as a bar in a terminal or as lines in a file."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column

from snowsplat.util.duration import duration
from snowsplat.util.messages import Message, message
from snowsplat.util.process_memory import resident_bytes

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.training.core.progress import Progress as TrainingProgress

_LINE_SECONDS = 5.0
_RATE_SECONDS = 3.0  # the displayed rate is a running mean over about this time
_LOSS_STEPS = 50  # the displayed loss is a running mean over about this number of steps


class StepProgress:
    """Called after each step. `close` removes the bar's thread and leaves its last line."""

    def __init__(self, total: int, start: int = 0, stream: TextIO | None = None) -> None:
        self.total = total
        self.stream = stream or sys.stdout
        self._start_step = start
        self._start_time = self._last_time = time.monotonic()
        self._last_line = self._start_time - _LINE_SECONDS + 1.0  # the first line after a second
        self._last_step = start
        self._rate = 0.0  # steps per second
        self._loss = math.nan
        self._psnr = Message("")
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if self.stream.isatty():
            # Never truncated, because a truncated number is misleading.
            whole = Column(no_wrap=True, min_width=2 * len(str(total)) + 1)
            self._bar = Progress(
                TextColumn("{task.completed}/{task.total}", table_column=whole),
                BarColumn(bar_width=None),
                TextColumn("{task.description}"),
                console=Console(file=self.stream),
                expand=True,
                refresh_per_second=4,
            )
            self._task = self._bar.add_task("starting", total=total, completed=start)
            self._bar.start()

    def close(self) -> None:
        """Stop updating the bar."""
        if self._bar is not None:
            self._bar.stop()

    @property
    def seconds(self) -> float:
        """Time since the first step began."""
        return time.monotonic() - self._start_time

    def __call__(self, progress: TrainingProgress) -> None:
        now = time.monotonic()
        weight = 1.0 if math.isnan(self._loss) else 1.0 / _LOSS_STEPS
        self._loss = (
            progress.loss if weight == 1.0 else self._loss + weight * (progress.loss - self._loss)
        )
        self.total = progress.iterations
        self._update_rate(progress.step, now)
        done = progress.step >= self.total
        if progress.metrics is not None and progress.metrics.views:
            means = progress.metrics
            self._psnr = message("  PSNR {psnr:.2f} at {size}", psnr=means.psnr, size=means.size)
            self.say(str(held_out_line(progress.step, progress.metrics)))
        if self._bar is not None:
            text = self._text(progress)
            self._bar.update(
                self._task, completed=progress.step, total=self.total, description=text
            )
        elif done or now - self._last_line >= _LINE_SECONDS:
            self._last_line = now
            percent = 100 * progress.step // self.total
            self.say(
                str(
                    message(
                        "step {step}/{total} ({percent}%)  {text}",
                        step=progress.step,
                        total=self.total,
                        percent=percent,
                        text=self._text(progress),
                    )
                )
            )

    def say(self, line: str) -> None:
        """Print a line, above the bar."""
        print_above(self._bar, line, self.stream)

    def _update_rate(self, step: int, now: float) -> None:
        elapsed = now - self._last_time
        if elapsed < 0.25 and step < self.total:
            return
        rate = (step - self._last_step) / max(elapsed, 1e-9)
        keep = math.exp(-elapsed / _RATE_SECONDS) if self._rate else 0.0
        self._rate = keep * self._rate + (1.0 - keep) * rate
        self._last_time, self._last_step = now, step

    def _text(self, progress: TrainingProgress) -> str:
        rate = self._rate or (progress.step - self._start_step) / max(self.seconds, 1e-9)
        left = progress.seconds_left
        if progress.step >= self.total:
            remaining = message("done in {time}", time=duration(self.seconds))
        else:
            remaining = Message("")
            if left is not None:
                remaining = message("{time} left", time=duration(left))
        return str(
            message(
                "{rate:.1f} it/s  loss {loss:.4f}  {gaussians:,} Gaussians{psnr}  {memory:.0f} MB  "
                "{remaining}",
                rate=rate,
                loss=self._loss,
                gaussians=progress.gaussians,
                psnr=self._psnr,
                memory=resident_bytes() / 1e6,
                remaining=remaining,
            )
        )


def print_above(bar: Progress | None, line: str, stream: TextIO) -> None:
    """Print a line above the bar, or to ``stream`` if there is none."""
    if bar is not None:
        bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
    else:
        print(line, file=stream, flush=True)


def held_out_line(step: int, evaluation: Evaluation) -> Message:
    """Step, number and size of the views, and the mean figures."""
    line = message(
        "step {step}: {count} views of {size}  PSNR {psnr:.2f} dB  SSIM {ssim:.3f}  colour-aligned "
        "PSNR {aligned:.2f} dB",
        step=step,
        count=len(evaluation.views),
        size=evaluation.size,
        psnr=evaluation.psnr,
        ssim=evaluation.ssim,
        aligned=evaluation.psnr_aligned,
    )
    if evaluation.lpips is not None:
        line = message("{line}  LPIPS {lpips:.3f}", line=line, lpips=evaluation.lpips)
    if rest := evaluation.line_of_unjudged():
        line = message("{line}; {rest}", line=line, rest=rest)
    return line
