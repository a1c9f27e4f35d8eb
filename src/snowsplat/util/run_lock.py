"""One run per folder: a lock that ends with its process, and says who holds it.

The lock is that of the operating system on an open file, so a killed process leaves none. The file
names its holder for messages. Some network file systems do not pass locks on to other computers.
Therefore the holder also renews the time of the file, and a run that gets a lock whose file names
another computer waits until it is sure that nobody renews it.
"""

from __future__ import annotations

import json
import os
import shlex
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import from_json, parse_json, printable

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt

#: The file of the lock in a folder. It is removed at the end of the run.
LOCK = ".snowsplat.lock"
# A killed process may take so long to end and to free its memory; its lock ends with it.
_WAIT_SECONDS = 3.0
_RENEW_SECONDS = 2.0
# A holder on another computer that does not renew its lock for so long has ended.
_SILENT_SECONDS = 12.0
_MAX_BYTES = 4096  # of the text in the file
_MAX_COMMAND = 200  # characters
_FAR = 1 << 30  # the locked byte: on Windows, nobody can read it


class InUse(UserError):
    """Another run holds the lock."""


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock, as its file says; an empty one is not known."""

    host: str = ""
    process: int = 0
    since: str = ""  # local time
    command: str = ""

    @classmethod
    def this_process(cls) -> Holder:
        program = Path(sys.argv[0]).name.replace("__main__.py", "snowsplat")
        command = shlex.join([program, *sys.argv[1:]])
        short = command if len(command) <= _MAX_COMMAND else command[: _MAX_COMMAND - 1] + "…"
        now = time.strftime("%Y-%m-%d %H:%M:%S")
        return cls(socket.gethostname(), os.getpid(), now, printable(short))

    def __str__(self) -> str:
        return str(self.description())

    def description(self) -> Message:
        """Which process it is, and what it runs."""
        if not self.host:
            return message("another process")
        return message(
            "process {process} on {host}, since {since}: {command}",
            process=self.process,
            host=printable(self.host),
            since=printable(self.since),
            command=printable(self.command),
        )


@contextmanager
def one_run(folder: Path, wait: float = _WAIT_SECONDS) -> Iterator[None]:
    """Hold the lock of an output folder during the block.

    The folder and those above it are created; at the end, they are removed if they are empty.

    Raises:
        InUse: another run writes to the folder; the message says which one.
        UserError: ``folder`` is a file.
        OSError: the folder cannot be created or is not writable.
    """
    while True:
        if folder.exists() and not folder.is_dir():
            raise UserError("{folder}: is a file; use a folder", folder=folder)
        missing = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        try:
            handle = _acquired(folder / LOCK, str(folder), wait)
            break
        except FileNotFoundError:  # another run has just removed the empty folder
            continue
        except OSError as error:
            error.filename = str(folder)
            raise
    try:
        with _held(folder / LOCK, handle):
            yield
    finally:
        with suppress(OSError):  # it contains results
            for path in missing:
                path.rmdir()


@contextmanager
def locked(file: Path, what: str, wait: float = _WAIT_SECONDS) -> Iterator[None]:
    """Hold a lock during the block. The file is created, and removed at the end.

    Args:
        what: what is in use if another process holds it, for the message: "garden".
        wait: seconds to wait for a process that is just ending.

    Raises:
        InUse: another process holds it.
        OSError: the folder of the file is missing or not writable.
    """
    with _held(file, _acquired(file, what, wait)):
        yield


def is_locked(file: Path) -> bool:
    """Whether another process holds a lock. Of a file that cannot be written, such as that of
    another user, only the lock of the operating system counts."""
    if not file.exists():
        return False
    try:
        with locked(file, "", wait=0.0):
            return False
    except InUse:
        return True
    except OSError:
        return _is_held(file)


def _is_held(file: Path) -> bool:
    try:
        handle = os.open(file, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
        try:
            return not _lock(handle)
        finally:
            os.close(handle)
    except OSError:  # it has just been removed, cannot be read, or there are no locks
        return False


def _acquired(file: Path, what: str, wait: float) -> int:
    """The handle of the locked file, which names this process as the holder."""
    end = time.monotonic() + wait
    while (found := _try(file)) is None:
        if time.monotonic() >= end:
            raise _in_use(what, file)
        time.sleep(0.05)
    handle, has_locks = found
    try:
        before = holder(file)
        sure = has_locks and before.host == socket.gethostname()
        if before.host and not sure and _is_renewed(file):
            raise _in_use(what, file)
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(asdict(Holder.this_process())).encode())
    except BaseException:
        os.close(handle)
        raise
    return handle


def _in_use(what: str, file: Path) -> InUse:
    return InUse(
        "{what}: in use by {holder}; wait until it ends, stop it, or use another folder",
        what=what,
        holder=holder(file).description(),
    )


def _try(file: Path) -> tuple[int, bool] | None:
    """Open and lock the file; None if another process or thread has the lock. Returns its handle,
    and whether the file system has locks."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)
    handle = os.open(file, flags, 0o666)
    try:
        is_ours, has_locks = _lock(handle), True
    except OSError:
        is_ours, has_locks = True, False
    # The previous holder may have removed the file between opening and locking.
    if is_ours and _is_at(file, handle):
        return handle, has_locks
    os.close(handle)
    return None


def _lock(handle: int) -> bool:
    """Lock an open file; False if somebody else has the lock.

    Raises: OSError: the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            os.lseek(handle, _FAR, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _is_at(file: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(file))
    except FileNotFoundError:
        return False


def holder(file: Path) -> Holder:
    """The process that holds a lock, or that was killed while it held it, as its file says."""
    try:
        with open(file, "rb") as opened:
            return from_json(Holder, parse_json(opened.read(_MAX_BYTES)))
    except (OSError, ValueError):
        return Holder()


def _is_renewed(file: Path) -> bool:
    """Whether the holder renews the file. Opening it asks the server of a network file system."""
    begin = time.monotonic()
    first = _renewed_at(file)
    while time.monotonic() - begin < _SILENT_SECONDS:
        time.sleep(0.5)
        if _renewed_at(file) != first:
            return True
    return False


def _renewed_at(file: Path) -> int:
    with open(file, "rb") as opened:
        return os.fstat(opened.fileno()).st_mtime_ns


@contextmanager
def _held(file: Path, handle: int) -> Iterator[None]:
    """Renew the lock during the block; then remove its file, and release it."""
    done = threading.Event()
    renewing = threading.Thread(target=_renew, args=(file, handle, done), daemon=True)
    renewing.start()
    try:
        yield
    finally:
        done.set()
        renewing.join()
        ours = _is_at(file, handle)  # the folder may have been moved
        if sys.platform != "win32" and ours:
            file.unlink(missing_ok=True)
        os.close(handle)
        if sys.platform == "win32" and ours:  # open files cannot be removed there
            with suppress(OSError):  # the next holder has opened it
                file.unlink()


def _renew(file: Path, handle: int, done: threading.Event) -> None:
    while not done.wait(_RENEW_SECONDS):
        with suppress(OSError):
            os.utime(handle if os.utime in os.supports_fd else file)
