"""Inputs of tests that are expensive to make and depend on sources alone, kept between runs."""

from __future__ import annotations

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
    """A folder that ``make`` has filled from the ``sources`` as they are; not to be changed.

    It is made again where one of the sources has changed. Several processes may ask for it at once:
    each one finds it complete or makes its own, and the first one stays.
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
