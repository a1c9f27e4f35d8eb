"""Whole files or none: what the program writes appears under its name when it is complete."""

import contextlib
import json
import os
import re
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows has none
    fcntl = None  # type: ignore[assignment]

_TEMPORARY = re.compile(r"\.(.+?)(\.[a-z0-9_]{8})?\.tmp")


def _default_mode() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


@contextlib.contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Give a temporary name beside ``path``; rename it to ``path`` when the block ends well.

    The temporary lies in the same folder, so that the rename is one step of one file system, and is
    synced before it: after a crash or a power cut ``path`` holds the old content or the new, never
    a part. If the block raises, the temporary is removed and ``path`` is as it was. What a kill
    leaves of it, the next write of ``path`` takes for its own.

    Raises:
        OSError: the folder is absent or not writable, or the disk is full. It names ``path``.
    """
    path = Path(path)
    try:
        handle, temporary = _temporary(path)
        try:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.chmod(temporary, _default_mode())  # so far it is private
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
        beside = str(path.with_name(f".{path.name}."))
        ours = not named or any(name.startswith(beside) for name in named)
        better = OSError(error.errno, error.strerror, str(path))
        if ours and type(error) is type(better) and error.errno is not None:
            raise better from error
        raise
    _sync_folder(path.parent)


def _temporary(path: Path) -> tuple[int | None, Path]:
    """An empty file beside ``path``, and the handle that says that it is in use.

    It has always the same name, and a lock as long as its writer lives: so one that a kill has left
    is told from one that another process or thread writes now. Then, and where there are no locks,
    it is one of a random name.
    """
    if fcntl is not None:
        temporary = path.with_name(f".{path.name}.tmp")
        with contextlib.suppress(OSError):
            return _locked(temporary), temporary
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    os.close(handle)
    return None, Path(name)


def _locked(temporary: Path) -> int:
    """The handle of an empty file that nobody else has.

    Raises:
        OSError: somebody else has it, there are no locks here, or no such file can be.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    handle = os.open(temporary, flags, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Its last writer may have renamed it between the two lines above.
        if not os.path.samestat(os.fstat(handle), os.stat(temporary)):
            raise FileNotFoundError(temporary)
        os.ftruncate(handle, 0)
    except BaseException:
        os.close(handle)
        raise
    return handle


def is_temporary(path: Path, names: Collection[str]) -> bool:
    """Whether `atomic_path` gives this name to a file of one of these."""
    match = _TEMPORARY.fullmatch(path.name)
    return match is not None and match[1] in names


def remove_temporaries(folder: Path, names: Collection[str]) -> None:
    """Remove from ``folder`` what a kill has left of `atomic_path` for files of these names."""
    for path in folder.glob(".*.tmp"):
        if is_temporary(path, names):
            path.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    # Makes the rename itself durable. Windows cannot open a folder, and some network file systems
    # refuse to sync one: there the rename is atomic all the same, only later on disk.
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path | str, value: Any) -> None:
    """Write a JSON file atomically. NaN and infinity become null, which strict readers accept."""
    write_text(path, json.dumps(_finite(value), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def shown(path: Path | str) -> str:
    """A path for people: bytes that are no text become "?"."""
    return str(path).encode("utf-8", "replace").decode()
