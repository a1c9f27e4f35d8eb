"""Reading and atomic writing: a file appears under its name only when it is complete."""

import contextlib
import ctypes
import itertools
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from snowsplat.util.errors import UserError, cause_of

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: How the pointer begins that Git LFS puts in the place of a file.
GIT_LFS = b"version https://git-lfs.github.com/spec/"
#: Called with the absolute path of a file before it is written and before it gets its name; they
#: raise `UserError` if it must not be, such as `run_lock.LostLock`.
CHECKS: list[Callable[[Path], None]] = []
#: Called by `atomic_path` with the facts of a complete file before it gets its name, a key.
COMPLETE: dict[Path, Callable[[os.stat_result], None]] = {}
#: The folder in which `new_entries` makes what belongs into the folder around it.
STAGE = ".snowsplat.new"
_HERE = -100  # AT_FDCWD: paths are relative to the working folder
_TEMPORARY = re.compile(r"\.(.+?)(\.[a-z0-9_]{8})?\.tmp")


@contextlib.contextmanager
def atomic_path(path: Path | str, *, private: bool = False) -> Iterator[Path]:
    """Context with a temporary file that is renamed to ``path`` when the block ends.

    The temporary file is in the same folder, so the rename is atomic, and it is synced before the
    rename. After a crash or a power cut, ``path`` has either the old or the new content, never a
    part of it. If the block raises, the temporary file is removed and ``path`` does not change. If
    the process is killed, the temporary file stays; the next write of ``path`` reuses it.
    ``private``: other users cannot read the file, also if they can write to the folder.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full. It names ``path``.
        UserError: one of `CHECKS` does not permit it.
    """
    path = Path(path)
    _check(path)
    try:
        handle, temporary = _temporary(path, private)
        try:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())  # network file systems then know its time
            if path in COMPLETE:
                COMPLETE[path](temporary.stat())
            if not private:  # as mkstemp and _lock create them
                os.umask(mask := os.umask(0))
                os.chmod(temporary, 0o666 & ~mask)
            _check(path)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        finally:
            if handle is not None:
                os.close(handle)
    except OSError as error:
        named = [str(name) for name in (error.filename, error.filename2) if name is not None]
        ours = not named or any(Path(name).name.startswith(f".{path.name}.") for name in named)
        better = OSError(error.errno, error.strerror, str(path))
        if ours and type(error) is type(better) and error.errno is not None:
            raise better from error
        raise
    _sync_folder(path.parent)


def _check(*paths: Path) -> None:
    for check, path in itertools.product(list(CHECKS), paths):
        check(path.absolute())


def _temporary(path: Path, private: bool) -> tuple[int | None, Path]:
    """An empty file beside ``path``, and the handle of its lock (None without a lock).

    The name of the file is always the same, and the writer holds a lock on it. A killed process has
    no lock any more, so the file that it left is reused. If another process or thread holds the
    lock, or if the system has no locks, the file gets a random name. So does a ``private`` one,
    because another user may have created that of the usual name.
    """
    if fcntl is not None and not private:
        temporary = path.with_name(f".{path.name}.tmp")
        with contextlib.suppress(OSError):
            return _lock(temporary), temporary
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    os.close(handle)
    return None, Path(name)


def _lock(temporary: Path, folder: bool = False) -> int:
    """Create or open a file, lock and empty it, or lock a folder; return its handle.

    Raises: OSError: another writer holds the lock, locks are not supported, or the file cannot be
    created.
    """
    flags = os.O_RDONLY | os.O_DIRECTORY if folder else os.O_RDWR | os.O_CREAT
    handle = os.open(temporary, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Between open and flock, the previous writer may have renamed it.
        if not os.path.samestat(os.fstat(handle), os.stat(temporary)):
            raise FileNotFoundError(temporary)
        if not folder:
            os.ftruncate(handle, 0)
    except BaseException:
        os.close(handle)
        raise
    return handle


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context for reading a file: raises `UserError` instead of `OSError`, and for a pointer of
    Git LFS, which is in the place of a file that was not downloaded."""
    try:
        if path.is_file() and path.stat().st_size < 1024 and path.read_bytes().startswith(GIT_LFS):
            raise UserError("{path}: is a pointer of Git LFS; run git lfs pull", path=path)
        yield
    except OSError as error:
        raise UserError(
            "{path}: cannot be read ({strerror})", path=path, strerror=cause_of(error)
        ) from None


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Context with an empty folder, which is removed at the end.

    Like the temporary file of `atomic_path`, it has the name ``path``, so that the next call
    removes what a killed process has left there, or a random one if another process holds it.
    """
    is_new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    handle, folder = None, path
    try:
        if path.is_symlink():
            raise NotADirectoryError(path)
        handle = _lock(path, folder=True) if fcntl is not None else None
    except OSError as error:
        folder = Path(tempfile.mkdtemp(prefix=f"{path.name}.", dir=path.parent))
        if is_new and not isinstance(error, BlockingIOError):  # nobody holds it
            path.rmdir()
    try:
        for left in folder.iterdir():
            _remove(left)
        yield folder
    finally:
        _remove(folder)
        if handle is not None:
            os.close(handle)


@contextlib.contextmanager
def new_entries(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Context with an empty folder, whose entries replace those in ``folder`` at the end.

    It is `STAGE` in ``folder``, so the disk must have the space for both. All is synced before
    the first entry is replaced, and an entry is never a part of itself. If the block raises, or the
    process is killed in it, nothing has changed.

    Args:
        names: files and folders, such as "images" or "distorted/masks". Those that the block has
            not made are removed. The last one shows that the others belong together: if there are
            several, it is removed first and comes last.

    Raises:
        OSError: ``folder`` cannot be written, or the disk is full.
        UserError: one of `CHECKS` does not permit it.
    """
    targets = [folder / name for name in names]
    _check(*targets)
    with new_folder(folder / STAGE) as new:
        yield new
        sync_entries(new)
        _check(*targets)
        if len(targets) > 1:
            _set_aside(targets[-1], new)
        for name, target in zip(names, targets, strict=True):
            is_made = os.path.lexists(made := new / name)
            if is_made and target.is_dir() and _exchanged(made, target):
                continue
            if not is_made or target.is_dir() or made.is_dir():
                _set_aside(target, new)
            if is_made:
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(made, target)
        _sync_folder(folder)


def sync_entries(folder: Path) -> None:
    """Make all files and folders in a folder durable."""
    for path in folder.rglob("*") if os.name == "posix" else ():
        if not path.is_symlink():
            _sync(path)


def _set_aside(path: Path, new: Path) -> None:
    """Move what is there, if there is something, to ``new``, where it is removed."""
    if os.path.lexists(path):
        os.replace(path, Path(tempfile.mkdtemp(dir=new)) / path.name)


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two folders at once; False: the system or the file system cannot."""
    if os.name != "posix":
        return False
    system = ctypes.CDLL(None)
    both = os.fsencode(one), os.fsencode(other)
    if hasattr(system, "renameat2"):  # Linux: RENAME_EXCHANGE
        return bool(system.renameat2(_HERE, both[0], _HERE, both[1], 2) == 0)
    if hasattr(system, "renamex_np"):  # macOS: RENAME_SWAP
        return bool(system.renamex_np(*both, 2) == 0)
    return False


def _remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # an empty one, if no file can be opened
            path.rmdir()
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def is_own(path: Path) -> bool:
    """Whether a file, not a link, belongs to this user. Raises OSError: it is missing."""
    about = os.lstat(path)
    return stat.S_ISREG(about.st_mode) and about.st_uid == getattr(os, "getuid", lambda: 0)()


def make_parent(path: Path) -> None:
    """Create the folder of a file. Raises UserError if there is a file in its place."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UserError(
            "{path}: a part of its folder is a file; use another folder", path=path
        ) from None


def check_target(path: Path, overwrite: bool) -> None:
    """Raises UserError: a file may not be written here: this is a folder, or a file that is there
    and not to be replaced."""
    if path.is_dir():
        raise UserError("{path}: is a folder; use a file name", path=path)
    if path.exists() and not overwrite:
        raise UserError("{path}: exists; use `overwrite` to replace it", path=path)


def check_output(folder: Path, known: Callable[[Path], bool]) -> None:
    """Raises UserError: results may not be written into this folder, which need not exist: it is a
    file, or has an entry that is not ``known``."""
    if folder.exists() and not folder.is_dir():
        raise UserError("{folder}: is a file; use a folder for the output", folder=folder)
    if folder.is_dir() and not all(map(known, folder.iterdir())):
        raise UserError(
            "{folder}: contains other files; use a new or an empty folder", folder=folder
        )


def is_temporary(path: Path, names: Collection[str]) -> bool:
    """Whether ``path`` is a temporary file of `atomic_path` for a file with one of ``names``."""
    match = _TEMPORARY.fullmatch(path.name)
    return match is not None and match[1] in names


def remove_temporaries(folder: Path, names: Collection[str]) -> None:
    """Remove the temporary files in ``folder`` that killed writers of these names have left."""
    for path in folder.glob(".*.tmp"):
        if is_temporary(path, names):
            path.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    # Makes the rename durable. Windows cannot open folders, and some network file systems cannot
    # sync them. There the rename is still atomic, but it may reach the disk later.
    with contextlib.suppress(OSError):
        _sync(folder)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: Path | str, data: bytes | Iterable[bytes]) -> None:
    """Write a file, or its parts one after the other, atomically; see `atomic_path`."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines([data] if isinstance(data, bytes) else data)


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises OSError like `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path | str, value: Any) -> None:
    """Write a JSON file atomically. NaN and infinity are written as null, as JSON requires.

    Raises OSError like `atomic_path`.
    """
    finite = json.loads(json.dumps(value), parse_constant=lambda _: None)
    write_text(path, json.dumps(finite, indent=2, allow_nan=False) + "\n")


def shown(path: Path | str) -> str:
    """A path as printable text: bytes that are not valid text become "?"."""
    return str(path).encode("utf-8", "replace").decode()
