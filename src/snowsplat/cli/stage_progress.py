"""`StageProgress`: one line per stage of a job, with a progress bar in a terminal."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from snowsplat.cli.step_progress import print_above
from snowsplat.util.duration import duration
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.sfm.progress import Report

_LINE_SECONDS = 5.0
_WIDTH = 10  # of the names of stages


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
