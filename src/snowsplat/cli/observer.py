"""`TerminalObserver`: prints the progress of a pipeline function.

`StageProgress` has a line or a bar for each stage, `StepProgress` for the steps of a training.
"""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column

from snowsplat.cli.command import print_message
from snowsplat.cli.pages import for_other_computers
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.stage_lines import described
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.machine import resident_bytes
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.pipeline.observer import Page
    from snowsplat.pipeline.run.results import TrainResult
    from snowsplat.sfm.progress import Report
    from snowsplat.training.core.trainer import Progress as TrainingProgress
    from snowsplat.util.stages import Outcome

_LINE_SECONDS = 5.0
_WIDTH = 10  # of the names of stages
_RATE_SECONDS = 3.0  # the displayed rate is a running mean over about this time
_LOSS_STEPS = 50  # the displayed loss is a running mean over about this number of steps


class TerminalObserver(Observer):
    """Prints results to stdout and, unless ``quiet``, also notes and progress.

    It is a context manager: leaving the context removes the progress bar, also after an error.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._stages = StageProgress(quiet)
        self._steps: StepProgress | None = None

    def __enter__(self) -> TerminalObserver:
        return self

    def __exit__(self, *_: object) -> None:
        self._stages.hide()
        self.steps_end()

    def note(self, line: Message) -> None:
        if self._steps is not None:
            self._steps.say(str(line))
        else:
            self._stages.say(str(line))

    def begin(self, stage: str) -> Report:
        return self._stages.begin(stage)

    def end(self, stage: str, outcome: Outcome) -> None:
        line, *details = described(stage, outcome.result)
        self._stages.end(str(line), outcome.seconds, outcome.again)
        if not outcome.again:
            for detail in details:
                self._stages.say(f"          {detail}")

    def leave(self) -> None:
        self._stages.hide()

    def steps_begin(self, step: int, iterations: int) -> None:
        self._stages.hide()
        if not self._quiet:
            self._steps = StepProgress(iterations, step)

    def step(self, progress: TrainingProgress) -> None:
        if self._steps is not None:
            self._steps(progress)

    def steps_end(self) -> None:
        if self._steps is not None:
            self._steps.close()
            self._steps = None

    def trained(self, result: TrainResult) -> None:
        steps = result.step - result.first_step
        count = message("{steps} more steps", steps=steps)
        if not result.first_step:
            count = message("{steps} steps", steps=steps)
        print_message(
            "{scene}: {gaussians:,} Gaussians, {st_size}, {count} in {seconds}, {memory}",
            scene=result.scene,
            gaussians=result.gaussians,
            st_size=format_bytes(result.scene.stat().st_size),
            count=count,
            seconds=duration(result.seconds),
            memory=result.memory,
        )
        for line in result.reductions:
            print_message("for lack of memory: {line}", line=line)
        print_message("{report}: the report of the training", report=result.report)
        if result.evaluation is not None:
            print(held_out_line(*result.evaluation))
        for part in result.parts.values():
            for each in part.lines:
                print(each)
        if result.time is not None:
            spent, given = map(duration, result.time)
            print_message("{spent} in total, of {given}", spent=spent, given=given)
        sys.stdout.flush()

    def page_opened(self, page: Page) -> None:
        print_message("watch it in a browser: {url}", url=page.url)
        for line in for_other_computers(page.url, page.others):
            print_message(line)


class WatchObserver(TerminalObserver):
    """The observer of `snowsplat watch`, which Ctrl-C ends."""

    def page_opened(self, page: Page) -> None:
        super().page_opened(page)
        print_message("Ctrl-C ends it")


class StageProgress:
    """Prints lines about stages to ``stream``.

    In a terminal, a progress bar shows the current stage from `begin` to `end` or `hide`. In a
    file, a line is printed every few seconds.
    """

    def __init__(self, quiet: bool = False, stream: TextIO | None = None) -> None:
        self.quiet = quiet
        self.stream = stream or sys.stdout
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._stage = self._what = ""
        self._start = self._last_line = time.monotonic()
        self._first = self._done = 0  # items: finished at the start, and now

    def begin(self, stage: str) -> Report:
        """A stage begins; returns its progress callback."""
        self._stage, self._what = stage, ""
        self._last_line = time.monotonic()
        self.hide()
        if self.stream.isatty() and not self.quiet:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=None),
                TextColumn("{task.fields[text]}"),
                console=Console(file=self.stream),
                expand=True,
                transient=True,
                refresh_per_second=4,
            )
            self._task = self._bar.add_task(stage, total=None, text="")
            self._bar.start()
        return self._report

    def hide(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def end(self, line: str, seconds: float, again: bool = False) -> None:
        """The stage is finished; ``again``: it was finished in an earlier run."""
        self.hide()
        took = message("done before") if again else duration(seconds)
        self.say(f"{self._stage:<{_WIDTH}}{line}  ({took})")

    def say(self, line: str) -> None:
        """Print a line, above the bar."""
        if not self.quiet:
            print_above(self._bar, line, self.stream)

    def _report(self, done: int, total: int, what: str = "", left: float | None = None) -> None:
        now = time.monotonic()
        if what != self._what or done == 0 or done < self._done:
            # Other items are counted now, or a second attempt begins. Some items may already be
            # finished.
            self._what, self._start, self._first = what, now, done
        self._done = done
        elapsed = now - self._start
        counted = f"{done}/{total} {what}" if total else f"{done or ''} {what}"
        text = ""
        if left is None and self._first < done < total and elapsed > 1.0:
            left = elapsed / (done - self._first) * (total - done)
        if left is not None:
            text = f"  {message('{time} left', time=duration(left))}"
        if self._bar is not None:
            self._bar.update(
                self._task, completed=done, total=total or None, text=f"{counted.strip()}{text}"
            )
        elif now - self._last_line >= _LINE_SECONDS:
            self._last_line = now
            self.say(f"{self._stage:<{_WIDTH}}{counted.strip()}{text}")


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
