"""A `snowsplat` command that can kill itself: ``watched_command.py RUN``, started by `harness`.

RUN is JSON: {"argv", "folder", "changes", "at", "delay", "limits"}. "argv" begins with `STUDIO` for
a worker of the studio. The command begins in "folder".
With "at" it kills its process group with SIGKILL before the at-th time that its Python code changes
a file in "folder", or "delay" seconds after that. If it ends by itself, it writes the number of
changes to the file "changes".
"""

import json
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from dataclasses import replace

import pycolmap  # noqa: F401  (so that kills do not hit the import)

#: The first word of the command of a worker of the studio.
STUDIO = "--studio"
_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def _kill_at(at: int | None, delay: float, watched: str, changes: list[int]) -> None:
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
        if os.path.isabs(name) and not name.startswith(watched):
            return
        changes[0] += 1
        if changes[0] == at:
            if delay:
                threading.Thread(target=end, daemon=True).start()
            else:
                end()

    sys.addaudithook(hook)


def _run(run: dict) -> int:
    os.chdir(run["folder"])
    tempfile.tempdir = None  # so that TMPDIR is read
    sys.argv = ["snowsplat", *run["argv"]]
    from snowsplat.cli.main import main as command_line
    from snowsplat.pipeline import make
    from snowsplat.studio.__main__ import main as studio

    # `make` with a very short training that always writes checkpoints.
    make._CHECKPOINT_SECONDS = 0.05
    make.PRESETS["draft"] = replace(make.PRESETS["draft"], iterations=60)
    count = os.open(run["changes"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for name, value in run["limits"].items():
        which = getattr(resource, name)
        if name == "RLIMIT_NOFILE":
            value += len(os.listdir("/proc/self/fd")) - 1  # one of them is that of listdir
        resource.setrlimit(which, (value, resource.getrlimit(which)[1]))
    changes = [0]
    _kill_at(run["at"], run["delay"], run["folder"], changes)
    try:
        is_studio = run["argv"][0] == STUDIO
        code = studio(run["argv"][1:]) if is_studio else command_line(run["argv"])
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    sys.stdout.flush()
    os.write(count, str(changes[0]).encode())
    return code


if __name__ == "__main__":
    code = 1
    try:
        code = _run(json.loads(sys.argv[1]))
    finally:
        os._exit(code)
