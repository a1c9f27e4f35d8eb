"""Runs the COLMAP worker as a child process, reports its progress and handles its failures."""

import contextlib
import dataclasses
import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.options import CAMERA_MODELS, SfmResult, thread_count
from snowsplat.sfm.colmap.process.growing_map import read_poses
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import MIN_PHOTOS, SfmOptions
from snowsplat.sfm.progress import Report, ShowPoses
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.limited_child import child_environment
from snowsplat.util.messages import as_message, message

# Bytes by which the database may grow in one transaction.
_DATABASE_GROWTH = 8_000_000
_MODULE = "snowsplat.sfm.colmap.process.worker"
_POLL_SECONDS = 0.5
_Watchers = tuple[Report, ShowPoses]


def estimate_poses(
    dataset: Path,
    photos: list[Photo],
    options: SfmOptions,
    report: Report,
    show_poses: ShowPoses = lambda photos, points: None,
) -> SfmResult:
    """Estimate the pose of each photo in ``input/`` of a dataset, and points of the scene.

    Writes three things. ``distorted/sparse/N`` are the models (0 has the most photos); the cameras
    include the lens distortion, and scale and orientation are arbitrary.
    ``distorted/database.db`` contains the features and matches. ``distorted/colmap.log`` is the
    output of COLMAP. Features and matches of an interrupted run are reused. The same photos and
    settings lead to the same pairs and matches, and to the same poses except for rounding. With
    more than 150 photos, the coordinate frame may differ, too.

    ``report`` is called at least twice per second, also if nothing has changed, ``show_poses``
    every two seconds while photos get poses.

    Raises:
        UserError: fewer than 3 photos, an unknown camera model, no poses found (the message
            explains why), or COLMAP crashed twice.
        OSError: the disk is full.
    """
    if len(photos) < MIN_PHOTOS:
        raise UserError(
            "photos: {photos} are not enough; take at least 3, preferably 30 or more",
            photos=len(photos),
        )
    if options.camera_model not in ("auto", *CAMERA_MODELS):
        raise SettingError(
            "camera_model",
            "unknown value {model!r}; use one of auto, {known}",
            model=options.camera_model,
            known=CAMERA_MODELS,
        )
    distorted = DatasetFolder(dataset.absolute()).distorted
    distorted.mkdir(parents=True, exist_ok=True)
    log = distorted / "colmap.log"
    log.unlink(missing_ok=True)
    job = {
        "dataset": str(dataset.absolute()),
        "photos": [dataclasses.asdict(photo) for photo in photos],
        "options": dataclasses.asdict(options),
    }
    watchers, crashes = (report, show_poses), list[int]()
    for threads in (thread_count(options.threads), 1):
        result = _run({**job, "reduced": bool(crashes)}, log, threads, watchers)
        if isinstance(result, SfmResult):
            notes = [
                f"first attempt: {_reason(code)}; repeated with smaller photos and one thread"
                for code in crashes
            ]
            return dataclasses.replace(result, attempts=[*notes, *result.attempts])
        crashes.append(result)
        _check_disk(distorted)
    advice = message("report it")
    if crashes[-1] < 0:
        advice = message("use fewer or smaller photos, or a lower effort")
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    raise UserError(
        "pose estimation: failed twice: {reason}; {advice} (last line of the log: {last_line})",
        reason=_reason(crashes[-1]),
        advice=advice,
        last_line=next((line.strip()[:200] for line in reversed(lines) if line.strip()), "none"),
    )


def _reason(code: int) -> str:
    """How the child ended without a result, as text; ``code`` is its exit status, negative for a
    signal."""
    if code == -getattr(signal, "SIGKILL", 9):
        return "it was killed, probably because the memory was full"
    if code < 0:
        return f"it crashed ({signal.Signals(-code).name})"
    return f"it ended with status {code}"


def _check_disk(folder: Path) -> None:
    """Raises OSError if there is no space for a larger file in ``folder``. In this case, the full
    disk is the likely cause of the crash."""
    try:
        largest = max(path.stat().st_size for path in folder.iterdir())
        with tempfile.TemporaryFile(dir=folder) as file:
            file.seek(largest)
            file.write(bytes(_DATABASE_GROWTH))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None


def _run(job: dict[str, Any], log: Path, threads: int, watchers: _Watchers) -> SfmResult | int:
    """The result of a child, or its exit status if it has ended without a result."""
    with (
        open(log, "ab") as log_file,
        subprocess.Popen(
            [sys.executable, "-m", _MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log_file,
            env=child_environment(threads),
            text=True,
            encoding="utf-8",
        ) as child,
    ):
        try:
            answer = _communicate(child, job, watchers)
            code = child.wait()
        finally:
            child.kill()
    if "user_error" in answer:
        raise UserError(as_message(answer["user_error"]))
    if "result" not in answer:
        return code
    result = answer["result"]
    reasons = {name: as_message(why) for name, why in result["unregistered"].items()}
    doubts = [as_message(doubt) for doubt in result["doubts"]]
    return SfmResult(**result | {"unregistered": reasons, "doubts": doubts})


def _communicate(
    child: subprocess.Popen[str], job: dict[str, Any], watchers: _Watchers
) -> dict[str, Any]:
    """Send the job, report progress until the child ends, and return its last line.

    ``report`` is called in this thread, so it needs no lock and Ctrl-C interrupts it. A second
    thread reads the lines.
    """
    report, show_poses = watchers
    lines: queue.Queue[str | None] = queue.Queue()

    def listen() -> None:
        assert child.stdout is not None
        # After an interrupt, the stream may be closed while it is read.
        with contextlib.suppress(ValueError), child.stdout:
            for line in child.stdout:
                lines.put(line)
        lines.put(None)

    threading.Thread(target=listen, daemon=True).start()
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # the child has ended: detected below
        child.stdin.write(json.dumps(job) + "\n")
        child.stdin.flush()
    answer: dict[str, Any] = {}
    while True:
        try:
            line = lines.get(timeout=_POLL_SECONDS)
        except queue.Empty:
            if "progress" in answer:
                report(*answer["progress"])
            continue
        # If the child has ended, the last line may be incomplete.
        if line is None or not line.endswith("\n"):
            break
        message = json.loads(line)
        if "poses" in message:
            show_poses(*read_poses(message["poses"]))
            continue
        answer = message
        if "progress" in answer:
            report(*answer["progress"])
    # stdin is closed only after the last answer, because the child ends when its stdin is closed.
    with contextlib.suppress(BrokenPipeError):
        child.stdin.close()
    return answer
