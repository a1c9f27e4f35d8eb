"""The child process in which COLMAP runs: it may crash, hang or be killed without us.

    python -m snowsplat.sfm.colmap.worker

One line of JSON on stdin is the job. Lines of JSON on stdout are progress, tables of the database
whose rows the parent may count meanwhile, and then the result or the user's error. Stdin stays open
as long as the parent lives: at its end the child ends at once. Ctrl-C is the parent's affair. What
COLMAP prints goes to stderr, which the parent puts into a log.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

import pycolmap

from snowsplat.sfm.colmap.features import SEED, Folders, Teller
from snowsplat.sfm.colmap.options import EFFORTS, SfmOptions, SfmResult, thread_count
from snowsplat.sfm.colmap.reconstruct import Reconstruction
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.errors import UserError


def main() -> None:
    """Do the one job that stdin names."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = _own_stdout()
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def say(**line: Any) -> None:
        answers.write(json.dumps(line) + "\n")
        answers.flush()

    try:
        teller = Teller(
            report=lambda *counts: say(progress=counts), watch=lambda *table: say(watch=table)
        )
        say(result=asdict(_work(job, teller)))
    except UserError as error:
        say(user_error=str(error))


def _own_stdout() -> TextIO:
    # Whatever C++ code prints must not fall between our lines.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return answers


def _end_with_parent() -> None:
    # Not by sys.stdin: a thread that waits there keeps Python from ending in order.
    while os.read(0, 4096):
        pass
    os._exit(1)


def _work(job: dict[str, Any], teller: Teller) -> SfmResult:
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.alsologtostderr = False
    pycolmap.logging.logtostderr = True
    # The mapper takes that back: then there is to be no file in the folder for temporary ones.
    for level in pycolmap.logging.Level.__members__.values():
        pycolmap.logging.set_log_destination(level, "")
    options = SfmOptions(**job["options"])
    effort, threads = EFFORTS[options.effort], thread_count(options.threads)
    if job["gentle"]:
        effort, threads = effort.gentler(), 1
    photos = [Photo(**photo) for photo in job["photos"]]
    folders = Folders(Path(job["capture"]))
    return Reconstruction(folders, photos, options, threads, teller).run(effort)


if __name__ == "__main__":
    main()
