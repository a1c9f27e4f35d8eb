"""One run per folder: a lock that ends with its process, and says who holds it.

The lock is that of the operating system on an open file, so a killed process leaves none, and a
process that sleeps keeps it. The file names its holder for messages.

If the file was removed, such as with its folder, another run can take the lock anew. So
`atomic_path` asks before each write below the folder of a lock; see `files.CHECKS`.
"""

from __future__ import annotations

import errno
import json
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from snowsplat.util import files
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
_MAX_BYTES = 4096  # of the text in the file
_MAX_COMMAND = 200  # characters
_FAR = 1 << 30  # the locked byte: on Windows, nobody can read it
# Child processes and links do not get it; and opening a pipe does not wait.
_FLAGS = sum(getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"))


class InUse(UserError):
    """Another run holds the lock."""


class LostLock(UserError):
    """The file of the lock is that of another run: this process writes nothing more."""


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
        UserError: ``folder`` is a file; or the file of the lock is none, or that of another user.
        OSError: the folder cannot be created or is not writable.
    """
    while True:
        if folder.exists() and not folder.is_dir():
            raise UserError("{folder}: is a file; use a folder", folder=folder)
        missing = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        try:
            handle = _acquire(folder / LOCK, str(folder), wait)
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
        UserError: the file is no lock, or that of another user.
        OSError: the folder of the file is missing or not writable.
    """
    with _held(file, _acquire(file, what, wait)):
        yield


def is_locked(file: Path) -> bool:
    """Whether another process holds a lock, also of a file that this process cannot write."""
    try:
        handle = os.open(file, os.O_RDONLY | _FLAGS)
    except OSError:  # it is missing, or no file
        return False
    try:
        return stat.S_ISREG(os.fstat(handle).st_mode) and not _lock(handle)
    finally:
        os.close(handle)


def holder(file: Path) -> Holder:
    """The process that holds a lock, or that was killed while it held it, as its file says."""
    with suppress(OSError, ValueError):
        handle = os.open(file, os.O_RDONLY | _FLAGS)
        try:
            if stat.S_ISREG(os.fstat(handle).st_mode):
                return from_json(Holder, parse_json(os.read(handle, _MAX_BYTES)))
        finally:
            os.close(handle)
    return Holder()


def _acquire(file: Path, what: str, wait: float) -> int:
    """The handle of the locked file, whose text names this process as the holder."""
    end = time.monotonic() + wait
    while (handle := _try(file)) is None:
        if time.monotonic() >= end:
            raise InUse(
                "{what}: in use by {holder}; wait until it ends, stop it, or use another folder",
                what=what,
                holder=holder(file).description(),
            )
        time.sleep(0.05)
    try:
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(asdict(Holder.this_process())).encode())
    except BaseException:
        os.close(handle)
        raise
    return handle


def _try(file: Path) -> int | None:
    """Open and lock the file; None if another process or thread has the lock."""
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT | _FLAGS, 0o666)
    except OSError as error:
        if error.errno == errno.EROFS or not os.path.lexists(file):
            raise
        # A killed process of another user has left it in a folder of this one; or it is no lock.
        if not file.is_symlink() and file.is_file() and not is_locked(file):
            with suppress(OSError):
                file.unlink()
                return None
        raise _foreign(file) from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise _foreign(file)
    # The previous holder may have removed the file between opening and locking.
    if _lock(handle) and _is_at(file, handle):
        return handle
    os.close(handle)
    return None


def _foreign(file: Path) -> UserError:
    return UserError(
        "{file}: is no lock, or that of another user; remove it if nobody else uses the folder",
        file=file,
    )


def _lock(handle: int) -> bool:
    """Lock an open file; False if somebody else has the lock. A file system without locks gives
    one to everybody."""
    try:
        if sys.platform == "win32":
            os.lseek(handle, _FAR, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return True
    return True


def _is_at(file: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(file))
    except FileNotFoundError:
        return False


@contextmanager
def _held(file: Path, handle: int) -> Iterator[None]:
    """Check each write during the block; then remove the file, and release the lock."""
    file = file.absolute()

    def check(path: Path) -> None:
        if path.is_relative_to(file.parent) and not _is_at(file, handle) and file.exists():
            raise LostLock(
                "{folder}: its lock was removed, and is now that of {holder}; this process stops "
                "and writes nothing more",
                folder=file.parent,
                holder=holder(file).description(),
            )

    files.CHECKS.append(check)
    try:
        yield
    finally:
        files.CHECKS.remove(check)
        ours = _is_at(file, handle)
        if sys.platform != "win32" and ours:
            file.unlink()
        os.close(handle)
        if sys.platform == "win32" and ours:  # open files cannot be removed there
            with suppress(OSError):  # the next holder has opened it
                file.unlink()
