"""Stores expensive inputs of tests, which depend only on source files, between runs."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_FOLDER = _ROOT / "build" / "tests"


def cached(name: str, sources: Iterable[Path], make: Callable[[Path], object]) -> Path:
    """The folder that ``make`` fills; read-only for the tests.

    It is made again after one of the ``sources`` has changed. Several processes may call this at
    once: each finds it complete or makes it, and the first result is stored.
    """
    key = hashlib.sha256()
    for path in sorted(sources):
        key.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    folder = _FOLDER / name / key.hexdigest()[:16]
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    outdated = [path for path in folder.parent.iterdir() if not path.name.startswith(".")]
    new = Path(tempfile.mkdtemp(prefix=".", dir=folder.parent))
    try:
        make(new)
        with suppress(OSError):  # another process was first
            os.rename(new, folder)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    for path in outdated:
        shutil.rmtree(path, ignore_errors=True)
    return folder
