"""The child process in which COLMAP runs, so that a crash of COLMAP does not end the parent.

    python -m snowsplat.sfm.colmap.worker

The job is one line of JSON on stdin. Lines of JSON on stdout are progress, database tables whose
rows the parent may count, and at the end the result or a user error. Stdin stays open as long as
the parent runs; when it closes, the child ends immediately. The child ignores Ctrl-C, which the
parent handles. The output of COLMAP goes to stderr, which the parent writes to a log.
"""

from __future__ import annotations

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

from snowsplat.sfm.colmap.features import SEED, Folders, WorkerProgress
from snowsplat.sfm.colmap.options import EFFORTS, SfmOptions, SfmResult, thread_count
from snowsplat.sfm.colmap.reconstruct import Reconstruction
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.errors import UserError


def main() -> None:
    """Run the job that is read from stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The handlers of COLMAP's logger allocate memory, so a crash within malloc would hang in them.
    faulthandler.enable()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    answers = _redirected_stdout()
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def send(**line: Any) -> None:
        answers.write(json.dumps(line) + "\n")
        answers.flush()

    try:
        progress = WorkerProgress(
            report=lambda *counts: send(progress=counts), watch=lambda *table: send(watch=table)
        )
        send(result=asdict(_run(job, progress)))
    except UserError as error:
        send(user_error=str(error))


def _redirected_stdout() -> TextIO:
    # C++ code also prints to stdout. Its output is redirected to stderr, separate from the JSON.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _end_with_parent() -> None:
    # os.read is used instead of sys.stdin, because Python cannot exit normally while a thread is
    # reading from sys.stdin.
    while os.read(0, 4096):
        pass
    os._exit(1)


def _run(job: dict[str, Any], progress: WorkerProgress) -> SfmResult:
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.alsologtostderr = False
    pycolmap.logging.logtostderr = True
    # COLMAP's mapper resets the two settings above. With an empty destination, the logger still
    # creates no log files in /tmp.
    for level in pycolmap.logging.Level.__members__.values():
        pycolmap.logging.set_log_destination(level, "")
    options = SfmOptions(**job["options"])
    effort, threads = EFFORTS[options.effort], thread_count(options.threads)
    if job["reduced"]:
        effort, threads = effort.reduced(), 1
    photos = [Photo(**photo) for photo in job["photos"]]
    folders = Folders(Path(job["capture"]))
    return Reconstruction(folders, photos, options, threads, progress).run(effort)


if __name__ == "__main__":
    main()
