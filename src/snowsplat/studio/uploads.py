"""Uploads in parts, which resume: a file appears under its name when all of it has arrived."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from snowsplat.studio.library import Scene, safe_name
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError

_PART = ".part"
# Free space on the disk that uploads leave, bytes: the job writes about as much as its photos.
_RESERVE = 1 << 30
_DEEPEST = 8  # folders of an uploaded folder that are kept


class NoSpace(UserError):
    """The disk is too full for a file."""


class WrongPart(UserError):
    """A part does not continue what has arrived.

    Attributes:
        received: the number of bytes that have arrived.
    """

    def __init__(self, message: str, received: int) -> None:
        super().__init__(message)
        self.received = received


def received(scene: Scene) -> dict[str, int]:
    """The number of bytes of each file that have arrived, by its path."""
    found = {}
    for folder, _, names in os.walk(scene.photos):
        for name in names:
            path = Path(folder) / name
            shown = path.relative_to(scene.photos).as_posix().removesuffix(_PART)
            found[shown] = path.stat().st_size
    return found


def write_part(scene: Scene, path: str, size: int, start: int, data: bytes) -> int:
    """Append a part of an uploaded file.

    Args:
        path: that of the file in the uploaded folder. Its names are made safe (`safe_path`).
        size: of the whole file in bytes.
        start: the number of bytes before the part.

    Returns:
        The number of bytes that have arrived.

    Raises:
        WrongPart: it does not follow what has arrived, or goes beyond the size.
        NoSpace: the rest of the file does not fit on the disk.
        UserError: the path is empty, or there is a folder in the place of the file.
    """
    target = scene.photos / safe_path(path)
    part = target.with_name(target.name + _PART)
    if target.is_file():
        before = target.stat().st_size
        if before == size:  # the answer to its last part was lost
            return size
        raise WrongPart(f"{path}: there is another file of this name", before)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        raise UserError(f"{path}: a part of its folder is a file; rename it") from None
    if target.is_dir():
        raise UserError(f"{path}: there is a folder of this name; rename the file")
    before = part.stat().st_size if part.is_file() else 0
    if start != before or start + len(data) > size:
        raise WrongPart(f"{path}: {before} bytes of it have arrived", before)
    free = shutil.disk_usage(target.parent).free
    if size - before + _RESERVE > free:
        raise NoSpace(
            f"{path}: {format_bytes(size - before)} do not fit on the disk, which has "
            f"{format_bytes(free)} left; free some space"
        )
    with open(part, "ab") as file:
        file.write(data)
    if start + len(data) == size:
        os.replace(part, target)
    return start + len(data)


def safe_path(path: str) -> Path:
    """A relative path without ".."; each name is that of a file on every system.

    Raises: UserError: nothing is left of it.
    """
    names = [name for name in re.split(r"[/\\]+", path) if name not in ("", ".", "..")]
    if not names:
        raise UserError("a file has no name")
    safe = [safe_name(name) for name in names[-_DEEPEST:]]
    # A name of ours means that it is not complete.
    safe[-1] = safe[-1].removesuffix(_PART) or "_"
    return Path(*safe)
