"""The processes of a scene: `start` and `stop` a job, ask whether one runs, and run other work."""

import json
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snowsplat.project.studio_scene import StudioScene
from snowsplat.util.errors import UserError
from snowsplat.util.files import is_own
from snowsplat.util.interrupts import ask_to_end, of_own_group
from snowsplat.util.messages import as_message, message
from snowsplat.util.run_lock import LOCK, holder, is_locked

_WORKER = [sys.executable, "-m", "snowsplat.studio"]
# By their lock: jobs that this process has started. They are asked whether they have ended, or
# they would stay in the table of processes.
_started: dict[Path, subprocess.Popen[bytes]] = {}


def start(scene: StudioScene, task: str = "make") -> None:
    """Start one of the `TASKS` of a scene, or resume it. It goes on if this process ends.

    Raises: UserError: it runs already.
    """
    if is_running(scene, task):
        if task == "make":
            raise UserError("this scene is being made already")
        raise UserError("a film of this scene is being made already")
    with open(scene.log(task), "wb") as log:
        _started[scene.lock(task)] = subprocess.Popen(
            [*_WORKER, task, str(scene.folder)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            **of_own_group(),
        )


def is_running(scene: StudioScene, task: str = "make") -> bool:
    """Whether a process, started here or elsewhere, does this."""
    return _own_process(scene, task) is not None or is_locked(scene.lock(task))


def _own_process(scene: StudioScene, task: str) -> subprocess.Popen[bytes] | None:
    process = _started.get(scene.lock(task))
    return process if process is not None and process.poll() is None else None


def is_being_made(scene: StudioScene) -> bool:
    """Whether its job runs, or a command in a terminal writes its output folder."""
    return is_running(scene) or is_locked(scene.made / LOCK)


def stop(scene: StudioScene, task: str = "make") -> None:
    """Ask the job to save what it has, and to end; does nothing if none runs.

    Raises: UserError: it runs on another computer.
    """
    process, lock = _own_process(scene, task), scene.lock(task)
    if process is not None:
        ask_to_end(process.pid)
        return
    if not is_locked(lock):
        return
    other = holder(lock)
    # Another user who can write to the folder could name any process of this one.
    if other.host == socket.gethostname() and other.process > 1 and is_own(lock):
        ask_to_end(other.process)
    else:
        where = other.host or message("another computer")
        raise UserError("this scene is being made on {where}; stop it there", where=where)


def work(scene: StudioScene, verb: str, **settings: Any) -> dict[str, Any]:
    """Run another task of the worker, and wait for its answer; see `snowsplat.studio.worker`.

    ``verb``: one of its `VERBS`; ``settings``: those of the verb.

    Raises: UserError: what the worker has said.
    """
    command = [*_WORKER, verb, str(scene.folder), json.dumps(settings)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True)
    answer = _last_line(done.stdout.decode("utf-8", "replace").splitlines())
    if answer is None:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise UserError(
            "an unexpected fault: {lines}",
            lines=lines[-1] if lines else message("the process was killed"),
        )
    if "error" in answer:
        raise UserError(as_message(answer["error"]))
    return answer


def _last_line(lines: Sequence[str]) -> dict[str, Any] | None:
    """Libraries may print other lines before it."""
    try:
        return dict(json.loads(lines[-1]))
    except (IndexError, ValueError, TypeError):
        return None
