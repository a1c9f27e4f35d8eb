"""Child processes that run modules of this package, and a trial reading of foreign files in one.

    python -m snowsplat.util.limited_child MODULE FUNCTION PATH BYTES SECONDS LIBRARY…

Libraries in C++, such as COLMAP and OpenUSD, do not check the counts in their files. With a damaged
count, they may allocate all memory, run for hours, or end the process. Therefore they first read a
file of an unknown source in a child process, which has limits of SECONDS of processor time and of
BYTES of additional memory.
"""

import importlib
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from snowsplat.util.errors import UserError
from snowsplat.util.machine import resident_bytes
from snowsplat.util.messages import Message

_SECONDS = 10.0  # processor time to start Python and the library
_BYTES_PER_SECOND = 1_000_000  # a low estimate of the reading speed
# The longest time, divided by the processor time: other programs may need most of the processors.
# Elsewhere, the processor time is not limited.
_WAITING = 20 if sys.platform == "linux" else 1
_MEMORY = 1 << 29  # bytes of memory that a file of any size may need
_MEMORY_PER_BYTE = 64  # bytes of memory that are added for each byte of the file
_POLL_SECONDS = 0.02


def child_environment(threads: int) -> dict[str, str]:
    """The environment of a child process that runs modules of this package.

    COLMAP and OpenUSD use ``threads`` threads there.
    """
    # The child imports modules from the same places as this process (a checkout or an installed
    # wheel), but not from the current folder.
    paths: Sequence[str] = [os.path.abspath(path) for path in sys.path if path]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
        "PXR_WORK_THREAD_LIMIT": str(threads),
    }


def check_readable(reader: Callable[[Path], object], path: Path, libraries: Sequence[str]) -> None:
    """Call ``reader(path)`` in a child process within limits of time and memory.

    The limits depend on the size of the file, or of the files in the folder ``path``.

    Args:
        reader: a function of a module.
        path: what it reads.
        libraries: modules that are imported before the memory is limited.

    Raises:
        UserError: what the reader raised, or that it reached a limit or ended the process.
    """
    files = path.iterdir() if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files if file.is_file())
    limit = _MEMORY + _MEMORY_PER_BYTE * size
    seconds = _SECONDS + size / _BYTES_PER_SECOND
    what = [reader.__module__, reader.__qualname__, str(path.absolute()), str(limit)]
    reason = b""
    with suppress(subprocess.TimeoutExpired):
        done = subprocess.run(
            [sys.executable, "-m", __name__, *what, str(math.ceil(seconds)), *libraries],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=child_environment(1),
            timeout=_WAITING * seconds,
        )
        if done.returncode == 0:
            return
        reason = done.stdout
    with suppress(ValueError):
        raise UserError(Message.from_json(json.loads(reason)))
    raise UserError(
        "{path}: is damaged or too large: reading it ended, or took too much memory or time; copy "
        "or export it again",
        path=path,
    )


def _limit(memory: int, seconds: int) -> None:
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        memory += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    else:
        # macOS does not limit the address space. A library that holds Python's lock, and Windows,
        # where the memory is not known, only have the limit of time.
        threading.Thread(target=_watch, args=[memory + resident_bytes()], daemon=True).start()


def _watch(most: int) -> None:
    while resident_bytes() <= most:
        time.sleep(_POLL_SECONDS)
    os._exit(1)


def _main(module: str, function: str, path: str, memory: str, seconds: str, *names: str) -> None:
    reader = getattr(importlib.import_module(module), function)
    for name in names:
        importlib.import_module(name)
    _limit(int(memory), int(seconds))
    try:
        reader(Path(path))
    except UserError as error:
        print(json.dumps(error.message.as_json()))
        sys.exit(1)


if __name__ == "__main__":
    _main(*sys.argv[1:])
