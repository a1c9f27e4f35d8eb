"""Runs child processes within a given time: side by side, or alone where they measure times.

A child prints what it finds as lines of JSON behind a mark (`finding`), as soon as it has it: what
a child that crashes or is late has found until then counts. Nothing here needs more than Python.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MARK = "@@ "
Finding = dict[str, Any]
_LOG_BYTES = 1 << 20  # of the log, of one job


def finding(kind: str, **values: Any) -> None:
    """In a child: tell the parent."""
    print(MARK + json.dumps({"kind": kind, **values}), flush=True)


@dataclass(frozen=True)
class Job:
    """A child process.

    Attributes:
        limit: seconds; it is ended then.
        alone: begins when nothing else runs, and nothing begins beside it.
        least: with less than so many seconds left it does not begin.
    """

    name: str
    command: Sequence[str]
    limit: float
    alone: bool = False
    least: float = 10.0
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Outcome:
    """How a job ended: "done", "failed", "late" or "not run", and why."""

    job: str
    state: str
    seconds: float = 0.0
    reason: str = ""


class Runner:
    """Runs jobs in their order, until a moment at most.

    Attributes:
        outcomes: of the jobs that are over.
    """

    def __init__(
        self,
        folder: Path,
        log: Path,
        until: float,
        width: int,
        on_finding: Callable[[str, Finding], None],
        say: Callable[[str], None] = print,
    ) -> None:
        """``folder``: for what children print. ``until``: of `time.monotonic`. ``width``: how many
        run side by side. ``on_finding(job, finding)`` is called for each, ``say`` for each job."""
        self.outcomes: list[Outcome] = []
        self._folder, self._log, self._until, self._width = folder, log, until, width
        self._on_finding, self._say = on_finding, say
        self._running: list[_Child] = []
        self._stopped = False

    def stop(self) -> None:
        """Ends `run` soon. For handlers of signals: an exception could lose a child."""
        self._stopped = True

    def run(self, jobs: Sequence[Job]) -> None:
        """Runs all, or until `stop`. Whatever ends this ends the children too."""
        waiting = list(jobs)
        try:
            while (waiting or self._running) and not self._stopped:
                for child in list(self._running):
                    child.read(self._on_finding)
                    outcome = child.outcome()
                    if outcome is not None:
                        self._end(child, outcome)
                while waiting and self._may_begin(waiting[0]):
                    self._begin(waiting.pop(0))
                time.sleep(0.05)
        finally:
            for child in list(self._running):
                child.kill()
                self._end(child, Outcome(child.job.name, "failed", child.seconds, "interrupted"))
            for job in waiting:
                self._add(Outcome(job.name, "not run", 0.0, "interrupted"))

    def _may_begin(self, job: Job) -> bool:
        if not self._running:
            return True
        beside_one_alone = any(child.job.alone for child in self._running)
        return not job.alone and not beside_one_alone and len(self._running) < self._width

    def _begin(self, job: Job) -> None:
        left = self._until - time.monotonic()
        if left < job.least:
            self._add(Outcome(job.name, "not run", 0.0, "no time was left"))
            return
        try:
            self._running.append(_Child(job, min(job.limit, left), self._folder))
        except OSError as error:
            self._add(Outcome(job.name, "failed", 0.0, str(error)))

    def _end(self, child: _Child, outcome: Outcome) -> None:
        self._running.remove(child)
        child.read(self._on_finding)
        if outcome.state == "failed" and not outcome.reason:
            outcome.reason = child.last_line or "it said nothing"
        with self._log.open("ab") as log:
            log.write(
                f"\n===== {child.job.name}: {outcome.state}, {outcome.seconds:.1f} s\n".encode()
            )
            log.write(child.output(_LOG_BYTES))
        child.close()
        self._add(outcome)

    def _add(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)
        reason = f": {outcome.reason[:200]}" if outcome.reason else ""
        self._say(f"{outcome.job}: {outcome.state}, {outcome.seconds:.1f} s{reason}")


class _Child:
    def __init__(self, job: Job, limit: float, folder: Path) -> None:
        self.job, self._limit = job, limit
        self._path = folder / f"{job.name.replace('/', '_').replace(' ', '_')}.txt"
        self._began = time.monotonic()
        self._file = self._path.open("wb")
        self._read = self._path.open("rb")
        self._partial = b""
        self.last_line = ""
        try:
            # A session of its own: what it starts ends with it.
            self._process = subprocess.Popen(
                list(job.command),
                stdin=subprocess.DEVNULL,
                stdout=self._file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **job.environment},
                start_new_session=True,
            )
        except OSError:
            self.close()
            raise

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def outcome(self) -> Outcome | None:
        """None while it runs; ends it when it is late."""
        code = self._process.poll()
        if code is None:
            if self.seconds <= self._limit:
                return None
            self.kill()
            reason = f"ended after {self._limit:.0f} s"
            return Outcome(self.job.name, "late", self.seconds, reason)
        if code == 0:
            return Outcome(self.job.name, "done", self.seconds)
        if code < 0:
            name = signal.Signals(-code).name
            said = f"; {self.last_line}" if self.last_line else ""
            return Outcome(self.job.name, "failed", self.seconds, name + said)
        return Outcome(self.job.name, "failed", self.seconds)

    def read(self, on_finding: Callable[[str, Finding], None]) -> None:
        """Takes note of the whole lines that are there by now."""
        *lines, self._partial = (self._partial + self._read.read()).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").strip()
            # Others may have begun the line, such as pytest with its dots.
            _, marked, rest = text.partition(MARK)
            if marked:
                with contextlib.suppress(ValueError):
                    on_finding(self.job.name, json.loads(rest))
            elif text:
                self.last_line = text

    def output(self, most: int) -> bytes:
        """What it printed beside its findings, without the middle where that is long."""
        lines = self._path.read_bytes().splitlines(keepends=True)
        content = b"".join(line for line in lines if MARK.encode() not in line)
        if len(content) <= most:
            return content
        return content[: most // 2] + b"\n ...\n" + content[-most // 2 :]

    def kill(self) -> None:
        with contextlib.suppress(OSError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)  # a process that the driver holds on to may stay

    def close(self) -> None:
        self._file.close()
        self._read.close()
