"""Runs child processes with time limits: in parallel, or alone if they measure times.

A child prints each finding at once as a line of JSON with a mark (`finding`), so the findings of a
child that crashes or exceeds its time are not lost. This module only needs Python.
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
_LOG_BYTES = 1 << 20  # in the log, per job


def finding(kind: str, **values: Any) -> None:
    """Report a finding to the parent; to be called in a child."""
    print(MARK + json.dumps({"kind": kind, **values}), flush=True)


@dataclass(frozen=True)
class Job:
    """A child process.

    Attributes:
        limit: seconds after which it is ended.
        alone: starts when no other job runs, and no other job starts while it runs.
        least: seconds that must be left in the run for it to start.
    """

    name: str
    command: Sequence[str]
    limit: float
    alone: bool = False
    least: float = 10.0
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Outcome:
    """How a job ended: "done", "failed", "late" or "not run", and the reason."""

    job: str
    state: str
    seconds: float = 0.0
    reason: str = ""


class Runner:
    """Runs jobs in order, until a deadline.

    Attributes:
        outcomes: of the finished jobs.
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
        """``folder``: for the output of children. ``until``: deadline of `time.monotonic`.
        ``width``: number of parallel jobs. ``on_finding(job, finding)`` is called for each finding,
        ``say`` for each job."""
        self.outcomes: list[Outcome] = []
        self._folder, self._log, self._until, self._width = folder, log, until, width
        self._on_finding, self._say = on_finding, say
        self._running: list[_Child] = []
        self._stopped = False

    def stop(self) -> None:
        """End `run` soon. For signal handlers, where an exception could leave a child running."""
        self._stopped = True

    def run(self, jobs: Sequence[Job]) -> None:
        """Run all jobs, or until `stop`. The children end with it in any case."""
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
        one_runs_alone = any(child.job.alone for child in self._running)
        return not job.alone and not one_runs_alone and len(self._running) < self._width

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
            outcome.reason = child.last_line or "no output"
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
            # A separate session, so that its children are killed with it.
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
        """The outcome; None while it runs. Ends it after its time limit."""
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
            detail = f"; {self.last_line}" if self.last_line else ""
            return Outcome(self.job.name, "failed", self.seconds, name + detail)
        return Outcome(self.job.name, "failed", self.seconds)

    def read(self, on_finding: Callable[[str, Finding], None]) -> None:
        """Read the complete lines printed so far."""
        *lines, self._partial = (self._partial + self._read.read()).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").strip()
            # Other output may precede the mark in a line, such as the dots of pytest.
            _, marked, rest = text.partition(MARK)
            if marked:
                with contextlib.suppress(ValueError):
                    on_finding(self.job.name, json.loads(rest))
            elif text:
                self.last_line = text

    def output(self, most: int) -> bytes:
        """Its output without findings; a long output is shortened in the middle."""
        lines = self._path.read_bytes().splitlines(keepends=True)
        content = b"".join(line for line in lines if MARK.encode() not in line)
        if len(content) <= most:
            return content
        return content[: most // 2] + b"\n ...\n" + content[-most // 2 :]

    def kill(self) -> None:
        with contextlib.suppress(OSError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)  # the driver may keep a process alive

    def close(self) -> None:
        self._file.close()
        self._read.close()
