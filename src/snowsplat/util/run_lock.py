"""One run per folder: a lock that ends with its process, and says who holds it.

The lock is that of the operating system on an open file, so a killed process leaves none. The file
names its holder for messages. Some network file systems do not pass locks on to other computers.
Therefore the holder also renews the time of the file, and a run that gets a lock whose file names
another computer waits until it is sure that nobody renews it.

A holder that slept, such as a laptop, may find that another run has taken its lock meanwhile. So
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
import threading
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
_RENEW_SECONDS = 2.0
# A holder on another computer that does not renew its lock for so long has ended.
_SILENT_SECONDS = 12.0
_MAX_BYTES = 4096  # of the text in the file
_MAX_COMMAND = 200  # characters
_FAR = 1 << 30  # the locked byte: on Windows, nobody can read it
# Child processes and links do not get it; and opening a pipe does not wait.
_FLAGS = sum(getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"))


class InUse(UserError):
    """Another run holds the lock."""


class LostLock(UserError):
    """Another run has taken the lock, or its file was removed: this process writes nothing more."""


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock, as its file says; an empty one is not known."""

    host: str = ""
    process: int = 0
    since: str = ""  # local time
    command: str = ""
    space: str = ""  # the name space of its number, which a container has of its own

    @classmethod
    def this_process(cls) -> Holder:
        program = Path(sys.argv[0]).name.replace("__main__.py", "snowsplat")
        command = shlex.join([program, *sys.argv[1:]])
        short = command if len(command) <= _MAX_COMMAND else command[: _MAX_COMMAND - 1] + "…"
        now = time.strftime("%Y-%m-%d %H:%M:%S")
        return cls(socket.gethostname(), os.getpid(), now, printable(short), _process_space())

    def is_dead(self) -> bool:
        """Whether it was a process of this computer that has certainly ended."""
        here = self.host == socket.gethostname() and self.space == _process_space()
        if sys.platform == "win32" or not here or self.process <= 0:
            return False
        try:
            os.kill(self.process, 0)
        except (ProcessLookupError, OverflowError):
            return True
        except OSError:  # it is that of another user
            pass
        return False

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


def _process_space() -> str:
    with suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""


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
            acquired = _acquired(folder / LOCK, str(folder), wait)
            break
        except FileNotFoundError:  # another run has just removed the empty folder
            continue
        except OSError as error:
            error.filename = str(folder)
            raise
    try:
        with _held(folder / LOCK, *acquired):
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
    with _held(file, *_acquired(file, what, wait)):
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
    except (OSError, UserError):
        return _is_free(file) is False


def _is_free(file: Path) -> bool | None:
    """Whether nobody holds the lock of a file that this process cannot write; None: unknown, as it
    was removed, is no file, cannot be read, or there are no locks."""
    try:
        handle = os.open(file, os.O_RDONLY | _FLAGS)
        try:
            return _lock(handle) if stat.S_ISREG(os.fstat(handle).st_mode) else None
        finally:
            os.close(handle)
    except OSError:
        return None


def _acquired(file: Path, what: str, wait: float) -> tuple[int, bytes]:
    """The handle of the locked file, and its text, which names this process as the holder."""
    end = time.monotonic() + wait
    while (found := _try(file)) is None:
        if time.monotonic() >= end:
            # The lock may be that of another user, who can read the file of a killed process. A
            # child that lives on without it cannot write: it has no longer the lock.
            if not holder(file).is_dead():
                raise _in_use(what, file)
            file.unlink(missing_ok=True)
        time.sleep(0.05)
    handle, has_locks = found
    try:
        before = holder(file)
        sure = has_locks and before.host == socket.gethostname()
        if before.host and not sure and _is_renewed(file):
            raise _in_use(what, file)
        os.ftruncate(handle, 0)
        text = json.dumps(asdict(Holder.this_process())).encode()
        os.write(handle, text)
    except BaseException:
        os.close(handle)
        raise
    return handle, text


def _in_use(what: str, file: Path) -> InUse:
    return InUse(
        "{what}: in use by {holder}; wait until it ends, stop it, or use another folder",
        what=what,
        holder=holder(file).description(),
    )


def _try(file: Path) -> tuple[int, bool] | None:
    """Open and lock the file; None if another process or thread has the lock. Returns its handle,
    and whether the file system has locks."""
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT | _FLAGS, 0o666)
    except OSError as error:
        if error.errno == errno.EROFS or not os.path.lexists(file):
            raise
        _remove_foreign(file)
        return None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise _foreign(file)
    try:
        is_ours, has_locks = _lock(handle), True
    except OSError:
        is_ours, has_locks = True, False
    # The previous holder may have removed the file between opening and locking.
    if is_ours and _is_at(file, handle):
        return handle, has_locks
    os.close(handle)
    return None


def _remove_foreign(file: Path) -> None:
    """Remove the lock that a killed process of another user has left in a folder of this one.

    Raises: UserError: it cannot be removed, is no lock, or may be in use.
    """
    other = holder(file).host not in ("", socket.gethostname())
    if not _is_free(file) or (other and _is_renewed(file)):
        raise _foreign(file)
    try:
        file.unlink(missing_ok=True)
    except OSError:
        raise _foreign(file) from None


def _foreign(file: Path) -> UserError:
    return UserError(
        "{file}: is no lock, or that of another user; remove it if nobody else uses the folder",
        file=file,
    )


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
        return from_json(Holder, parse_json(_read(file)[0]))
    except (OSError, ValueError):
        return Holder()


def _read(file: Path) -> tuple[bytes, os.stat_result]:
    """The text of a lock, and which file it is. Opening asks the server of a network file system.

    Raises: OSError: it is no file, or cannot be read.
    """
    handle = os.open(file, os.O_RDONLY | _FLAGS)
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise OSError(f"{file}: is no file")
        return os.read(handle, _MAX_BYTES), about
    finally:
        os.close(handle)


def _is_renewed(file: Path) -> bool:
    """Whether the holder renews the file."""
    begin = time.monotonic()
    first = _read(file)[1].st_mtime_ns
    while time.monotonic() - begin < _SILENT_SECONDS:
        time.sleep(0.5)
        if _read(file)[1].st_mtime_ns != first:
            return True
    return False


@contextmanager
def _held(file: Path, handle: int, text: bytes) -> Iterator[None]:
    """Renew the lock during the block; then remove its file, and release it."""
    file, done, writing = file.absolute(), threading.Event(), threading.Lock()
    handles = [handle]

    def is_ours() -> bool:
        try:
            now, about = _read(file)
        except FileNotFoundError:
            return False
        return now == text and os.path.samestat(about, os.fstat(handles[-1]))

    def takes_again() -> bool:
        """The folder was moved, or the file was removed: whether nobody else has taken it since."""
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL | _FLAGS, 0o666)
        except FileNotFoundError:  # the folder is missing
            return True
        except FileExistsError:
            return False
        handles.append(handle)
        os.write(handle, text)
        with suppress(OSError):  # there are no locks
            return _lock(handle)
        return True

    def check(path: Path) -> None:
        if not path.is_relative_to(file.parent):
            return
        with writing:
            lost = not is_ours() and not takes_again()
        if lost:
            raise LostLock(
                "{folder}: its lock was lost while this process slept, now to {holder}; this "
                "process stops and writes nothing more",
                folder=file.parent,
                holder=holder(file).description(),
            )

    def renew() -> None:
        while not done.wait(_RENEW_SECONDS):
            with suppress(OSError):
                if is_ours():
                    os.utime(handles[-1] if os.utime in os.supports_fd else file)

    renewing = threading.Thread(target=renew, daemon=True)
    renewing.start()
    files.CHECKS.append(check)
    try:
        yield
    finally:
        files.CHECKS.remove(check)
        done.set()
        renewing.join()
        try:
            ours = is_ours()
        except OSError:
            ours = False
        if sys.platform != "win32" and ours:
            file.unlink(missing_ok=True)
        for handle in handles:
            os.close(handle)
        if sys.platform == "win32" and ours:  # open files cannot be removed there
            with suppress(OSError):  # the next holder has opened it
                file.unlink()
