"""Runs `snowsplat` in forks of a process that has loaded all modules: a start takes milliseconds.

    python zygote.py FOLDER      one line of JSON per run on stdin, lines of JSON on stdout

The runs begin in FOLDER. The process is itself a fork of such a process; see fork_server.py.

A run is {"argv", "log", "watched", "at", "delay", "limits", "columns"}. It is a process with its
own process group. With "at" it kills its group with SIGKILL before the at-th time that its Python
code changes a file below a folder of "watched", or "delay" seconds after that. If it ends by
itself, the number of changes is written to LOG.changes. The responses are {"pid"} and {"code"}.
"""

import fcntl
import importlib
import json
import os
import pty
import resource
import signal
import struct
import sys
import tempfile
import termios
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def _kill_at(at: int | None, delay: float, watched: list[str], changes: list[int]) -> None:
    def end() -> None:
        if delay:
            time.sleep(delay)
        os.killpg(0, signal.SIGKILL)

    def hook(event: str, args: tuple) -> None:
        if event == "open":
            if not isinstance(args[2], int) or not args[2] & _WRITING:
                return
        elif event not in _CHANGES:
            return
        path = args[0]
        if not isinstance(path, str | bytes | os.PathLike):
            return
        # With a folder's file descriptor, the name is relative to it, as in rmtree.
        name = os.fsdecode(path)
        if os.path.isabs(name) and not name.startswith(tuple(watched)):
            return
        changes[0] += 1
        if changes[0] == at:
            if delay:
                threading.Thread(target=end, daemon=True).start()
            else:
                end()

    sys.addaudithook(hook)


def _terminal(log: int, columns: int) -> int:
    """A terminal of this width whose output goes to the log."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))

    def copy() -> None:
        while True:
            os.write(log, os.read(ours, 65536))

    threading.Thread(target=copy, daemon=True).start()
    return theirs


def _child(run: dict) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    log = os.open(run["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    if run.get("columns"):
        log = _terminal(log, run["columns"])
        os.environ.pop("COLUMNS", None)  # set by pytest-xdist; would replace the terminal's width
    os.dup2(null, 0)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    sys.argv = ["snowsplat", *run["argv"]]
    from snowsplat.cli.main import main
    from snowsplat.pipeline import make

    # `make` with a very short training that always writes checkpoints.
    make._CHECKPOINT_SECONDS = 0.05
    make.PRESETS["draft"] = replace(make.PRESETS["draft"], iterations=60)
    count = os.open(run["log"] + ".changes", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for name, value in run.get("limits", {}).items():
        which = getattr(resource, name)
        if name == "RLIMIT_NOFILE":
            value += len(os.listdir("/proc/self/fd")) - 1  # one of them is that of listdir
        resource.setrlimit(which, (value, resource.getrlimit(which)[1]))
    changes = [0]
    _kill_at(run.get("at"), run.get("delay", 0.0), run["watched"], changes)
    try:
        code = main(run["argv"])
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    sys.stdout.flush()
    if run.get("columns"):
        time.sleep(0.1)  # until the last output is copied
    os.write(count, str(changes[0]).encode())
    os._exit(code)


def serve() -> None:
    """Execute runs until stdin is closed."""
    os.chdir(sys.argv[1])
    tempfile.tempdir = None  # so that TMPDIR is read
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from imports import import_all

    import_all()
    # Imported after Python's zlib, because pycolmap would replace zlib by its own.
    importlib.import_module("pycolmap")
    for line in sys.stdin:
        run = json.loads(line)
        pid = os.fork()
        if pid == 0:
            try:
                os.setpgid(0, 0)
                _child(run)
            finally:
                os._exit(1)
        with suppress(OSError):  # it has already ended
            os.setpgid(pid, pid)
        print(json.dumps({"pid": pid}), flush=True)
        _, status = os.waitpid(pid, 0)
        print(json.dumps({"code": os.waitstatus_to_exitcode(status)}), flush=True)


if __name__ == "__main__":
    serve()
