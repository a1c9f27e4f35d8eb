"""The child process in which COLMAP runs, so that a crash of COLMAP does not end the parent.

    python -m snowsplat.sfm.colmap.process.worker

The parent sends the job as one line of JSON to stdin. The child answers with lines of JSON on
stdout: its progress; the photos that have a pose so far; and at the end the result or a
`UserError`. Stdin stays open as long as the parent runs; when it closes, the child ends
immediately. The child ignores Ctrl-C, which the parent handles. The output of COLMAP goes to
stderr, which the parent redirects to a log file.
"""

import faulthandler
import json
import os
import signal
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

import pycolmap

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.features.extraction import SEED, WorkerProgress
from snowsplat.sfm.colmap.options import EFFORTS, SfmResult, thread_count
from snowsplat.sfm.colmap.process.growing_map import PoseMessages
from snowsplat.sfm.colmap.reconstruct import PoseEstimation
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import SfmOptions
from snowsplat.util.errors import UserError


def main() -> None:
    """Run the job that is read from stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # COLMAP's logger handles the signals of a crash. Its handlers allocate memory, so the process
    # would hang after a crash within malloc. They are removed, because the handlers of Python would
    # call them.
    for name in ("SIGSEGV", "SIGABRT", "SIGFPE", "SIGBUS", "SIGILL", "SIGTERM"):
        if hasattr(signal, name):  # Windows has no SIGBUS
            signal.signal(getattr(signal, name), signal.SIG_DFL)
    faulthandler.enable()
    answers = _redirected_stdout()
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def send(**line: Any) -> None:
        answers.write(json.dumps(line) + "\n")
        answers.flush()

    def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
        send(progress=(done, total, what))

    try:
        progress = WorkerProgress(
            report=report,
            show_poses=PoseMessages(lambda message: send(poses=message)),
        )
        send(result=asdict(_run(job, progress)))
    except UserError as error:
        send(user_error=error.message.as_json())


def _redirected_stdout() -> TextIO:
    """The original stdout, for the JSON. All other output to stdout now goes to stderr."""
    # C++ code of COLMAP also prints to stdout, which would mix with the JSON.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _end_with_parent() -> None:
    """Wait until the parent has closed stdin, then end this process immediately."""
    # os.read is used instead of sys.stdin, because Python cannot exit normally while a thread is
    # reading from sys.stdin.
    while os.read(0, 4096):
        pass
    os._exit(1)


def _run(job: dict[str, Any], progress: WorkerProgress) -> SfmResult:
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.alsologtostderr = False
    pycolmap.logging.logtostderr = True
    # COLMAP's mapper resets the two settings above. With an empty destination, the logger creates
    # no log files in /tmp even then.
    for level in pycolmap.logging.Level.__members__.values():
        pycolmap.logging.set_log_destination(level, "")
    options = SfmOptions(**job["options"])
    effort, threads = EFFORTS[options.effort], thread_count(options.threads)
    if job["reduced"]:
        effort, threads = effort.reduced(), 1
    photos = [Photo(**photo) for photo in job["photos"]]
    dataset = DatasetFolder(Path(job["dataset"]))
    return PoseEstimation(dataset, photos, options, threads, progress).run(effort)


if __name__ == "__main__":
    main()
