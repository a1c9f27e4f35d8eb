"""Claims: which process trains a scene, if several of them share an output folder."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# A claim is renewed every `_RENEW_SECONDS`. If it is older than `_OLD_SECONDS`, its process has
# ended, or its computer is not connected.
_RENEW_SECONDS = 20.0
_OLD_SECONDS = 180.0


@contextmanager
def claimed(file: Path, wait: float = 0.0) -> Iterator[bool]:
    """Claim what ``file`` stands for, until the end of the block; False if somebody else has it.

    The file names the computer and the process. A claim of a process that has ended is replaced.

    Args:
        wait: seconds to wait for a process that is just ending.

    Raises:
        OSError: the folder is missing or not writable.
    """
    mine = f"{socket.gethostname()} {os.getpid()}"
    end = time.monotonic() + wait
    while not _create(file, mine) and not (_is_abandoned(file) and _replace(file, mine)):
        if time.monotonic() >= end:
            yield False
            return
        time.sleep(0.2)
    done = threading.Event()
    renewing = threading.Thread(target=_renew, args=(file, done), daemon=True)
    renewing.start()
    try:
        yield True
    finally:
        done.set()
        renewing.join()
        file.unlink(missing_ok=True)


def _create(file: Path, text: str) -> bool:
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(text)
    except FileExistsError:
        return False
    return True


def _is_abandoned(file: Path) -> bool:
    try:
        host, _, process = file.read_text(encoding="utf-8").partition(" ")
        age = time.time() - file.stat().st_mtime
    except OSError:  # it was just removed
        return False
    if host == socket.gethostname() and process.isdigit():
        return not _is_running(int(process))
    return age > _OLD_SECONDS


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it belongs to somebody else
        return True
    return True


def _replace(file: Path, text: str) -> bool:
    """Remove an abandoned claim. Of several processes, only one succeeds in renaming it."""
    old = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        file.rename(old)
    except OSError:
        return False
    old.unlink(missing_ok=True)
    return _create(file, text)


def _renew(file: Path, done: threading.Event) -> None:
    while not done.wait(_RENEW_SECONDS):
        with suppress(OSError):
            os.utime(file)
