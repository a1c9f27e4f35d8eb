"""The parent's side of the child process: starts it, listens, ends it, and tells how it ended."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snowsplat.errors import UserError
from snowsplat.photos.photo import Photo
from snowsplat.photos.progress import Report
from snowsplat.photos.sfm.options import SfmOptions, SfmResult, thread_count

_MODULE = "snowsplat.photos.sfm.worker"


class Crashed(Exception):
    """The child ended without an answer; ``code`` is its exit status, negative for a signal."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code

    @property
    def how(self) -> str:
        """The end of it, in words."""
        if self.code == -getattr(signal, "SIGKILL", 9):
            return "it was killed, most likely because the memory was full"
        if self.code < 0:
            return f"it crashed ({signal.Signals(-self.code).name})"
        return f"it ended with status {self.code}"


def estimate_poses(
    capture: Path, photos: list[Photo], options: SfmOptions, report: Report
) -> SfmResult:
    """Find where each photo of ``capture/input`` was taken, and points of the scene.

    Writes ``distorted/sparse/N`` (0 has most photos), in the photos' own cameras, at an arbitrary
    scale and orientation, and ``distorted/database.db``; ``distorted/colmap.log`` is what COLMAP
    said. Features and matches of an interrupted run are used again. The same photos and settings
    give the same pairs and matches; poses then differ by rounding alone.

    Raises:
        UserError: fewer than 3 photos, no poses to be found (the message says why), or COLMAP
            crashed twice.
    """
    if len(photos) < 3:
        raise UserError(
            f"{len(photos)} photos are too few to see depth; take at least 3, better 30 or more"
        )
    distorted = capture.absolute() / "distorted"
    distorted.mkdir(parents=True, exist_ok=True)
    log = distorted / "colmap.log"
    log.unlink(missing_ok=True)
    job = {
        "capture": str(capture.absolute()),
        "photos": [dataclasses.asdict(photo) for photo in photos],
        "options": dataclasses.asdict(options),
    }
    threads = thread_count(options.threads)
    try:
        return _run({**job, "gentle": False}, log, threads, report)
    except Crashed as crash:
        first = crash
    try:
        result = _run({**job, "gentle": True}, log, 1, report)
    except Crashed as crash:
        raise UserError(
            f"finding the camera positions failed twice: {crash.how}; use fewer or smaller "
            f"photos, or a lower quality ({log} has the details)"
        ) from None
    note = f"as asked: {first.how}; what follows was done with smaller photos and one thread"
    return dataclasses.replace(result, attempts=[note, *result.attempts])


def _run(job: dict[str, Any], log: Path, threads: int, report: Report) -> SfmResult:
    with open(log, "ab") as log_file:
        child = subprocess.Popen(
            [sys.executable, "-m", _MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log_file,
            env=_environment(threads),
            text=True,
            encoding="utf-8",
        )
    assert child.stdin is not None
    assert child.stdout is not None
    answer: dict[str, Any] = {}
    try:
        # A child that is dead already shows by its status.
        try:
            child.stdin.write(json.dumps(job) + "\n")
            child.stdin.flush()
        except BrokenPipeError:
            raise Crashed(child.wait()) from None
        for line in child.stdout:
            answer = json.loads(line)
            if "progress" in answer:
                report(*answer["progress"])
        code = child.wait()
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
        # Closing flushes, and the child may be gone with part of the job unread.
        with contextlib.suppress(BrokenPipeError):
            child.stdin.close()
    if "user_error" in answer:
        raise UserError(answer["user_error"])
    if "result" not in answer:
        raise Crashed(code)
    return SfmResult(**answer["result"])


def _environment(threads: int) -> dict[str, str]:
    # The child finds the modules that this process finds, from a checkout or a wheel, and not
    # what happens to lie in the current folder.
    paths: Sequence[str] = [os.path.abspath(path) for path in sys.path if path]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
    }
