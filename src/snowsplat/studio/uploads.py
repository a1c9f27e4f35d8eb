"""Uploads in parts, which resume: a file appears under its name when all of it has arrived."""

import filecmp
import itertools
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from snowsplat.project.studio_scene import PART, StudioScene
from snowsplat.studio.library import safe_name
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

# While it arrives, a file has its size and time in its name: that of another one is not continued.
_PART_NAME = re.compile(rf"(?P<name>.+)\.(?P<size>\d+)-(?P<modified>\d+){re.escape(PART)}", re.S)
_LATEST = 253_402_300_799_999  # the end of the year 9999, milliseconds since 1970
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

    def __init__(self, path: Path | str, received: int) -> None:
        super().__init__(message("{path}: {n} bytes of it have arrived", path=path, n=received))
        self.received = received


@dataclass(frozen=True)
class Upload:
    """A file of a browser. Its path, size and time tell it from others of the same name.

    Attributes:
        path: that in the uploaded folder. Its names are made safe (`safe_path`).
        size: bytes.
        modified: when it was changed last, milliseconds since 1970.
        received: the bytes of it that have arrived.
    """

    path: str
    size: int
    modified: int
    received: int = 0


def uploads(scene: StudioScene) -> list[Upload]:
    """The files that have arrived, and those of which a part has.

    A file that was complete when the process was killed gets its name.
    """
    found = []
    for folder, _, names in os.walk(scene.photos):
        for name in names:
            path = Path(folder) / name
            shown, about = path.relative_to(scene.photos), path.stat()
            part = _PART_NAME.fullmatch(name)
            if part:
                size, modified = int(part["size"]), int(part["modified"])
                shown = shown.with_name(part["name"])
                if about.st_size == size:
                    _finish(path, path.with_name(part["name"]), modified)
                found.append(Upload(shown.as_posix(), size, modified, about.st_size))
            elif not name.endswith(PART):
                size, modified = about.st_size, about.st_mtime_ns // 1_000_000
                found.append(Upload(shown.as_posix(), size, modified, size))
    return found


def write_part(scene: StudioScene, file: Upload, data: bytes) -> int:
    """Append a part of an uploaded file, after the bytes that it has received.

    If there is another file of this name, the file gets a number, unless both are the same.

    Returns:
        The number of bytes that have arrived.

    Raises:
        WrongPart: it does not follow what has arrived, or goes beyond the size.
        NoSpace: the rest of the file does not fit on the disk.
        UserError: the path is empty, or there is a file in the place of a folder.
    """
    path, size = file.path, file.size
    if file.modified > _LATEST:
        raise UserError("{path}: its time is after the year 9999", path=path)
    target = scene.photos / safe_path(path)
    there = itertools.takewhile(Path.exists, _numbered(target))
    # A photo that the user has left out is not taken again when its folder is dropped again.
    left_out = scene.left_out / safe_path(path)
    for other in (*there, *([left_out] if left_out.exists() else [])):
        about = other.stat()
        if (about.st_size, about.st_mtime_ns // 1_000_000) == (size, file.modified):
            return size  # the answer to its last part was lost, or it is dropped again
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        raise UserError("{path}: a part of its folder is a file; rename it", path=path) from None
    part = target.with_name(f"{target.name}.{size}-{file.modified}{PART}")
    before = part.stat().st_size if part.is_file() else 0
    end = file.received + len(data)
    if part.is_file() and before == size:  # all was written, and then the process was killed
        end, data = size, b""
    elif file.received != before or end > size:
        raise WrongPart(path, before)
    free = shutil.disk_usage(target.parent).free
    if size - before + _RESERVE > free:
        raise NoSpace(
            "{path}: {before} do not fit on the disk, which has {free} left; free some space",
            path=path,
            before=format_bytes(size - before),
            free=format_bytes(free),
        )
    with open(part, "ab") as opened:
        opened.write(data)
        if end == size:  # it is not sent again after a power cut
            opened.flush()
            os.fsync(opened.fileno())
    if end == size:
        _finish(part, target, file.modified)
    return end


def _finish(part: Path, target: Path, modified: int) -> None:
    """Give a complete file its name, or another one with a number; unless it is there already."""
    os.utime(part, ns=(modified * 1_000_000, modified * 1_000_000))
    for name in _numbered(target):
        if not name.exists():
            os.replace(part, name)
            return
        if name.is_file() and filecmp.cmp(part, name, shallow=False):
            part.unlink()
            return


def _numbered(path: Path) -> Iterator[Path]:
    """photo.jpg, photo-2.jpg, …"""
    yield path
    for number in itertools.count(2):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def safe_path(path: str) -> Path:
    """A relative path without ".."; each name is that of a file on every system.

    Raises: UserError: nothing is left of it.
    """
    names = [name for name in re.split(r"[/\\]+", path) if name not in ("", ".", "..")]
    if not names:
        raise UserError("a file has no name")
    safe = [safe_name(name) for name in names[-_DEEPEST:]]
    # A name of ours means that it is not complete.
    safe[-1] = safe[-1].removesuffix(PART) or "_"
    return Path(*safe)
