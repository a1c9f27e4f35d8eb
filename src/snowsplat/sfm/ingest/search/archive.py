"""Unpacks zip files of photos and videos, as cloud services and apps of phones give them.

A zip file may come from a stranger. Nothing is written outside of the new folder, links are not
created, and the unpacked size is bounded by the size of the file.
"""

import os
import shutil
import stat
import struct
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from snowsplat.util.errors import Problem, UserError, cause_of
from snowsplat.util.files import new_entries, shown
from snowsplat.util.messages import Message, as_message, message

# Other archives, by their first bytes. They are named, not unpacked.
_OTHERS = {b"Rar!": "RAR", b"7z\xbc\xaf": "7z", b"\x1f\x8b": "gzip", b"\xfd7zXZ": "xz"}
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")  # the latter: an empty one
# Photos and videos are compressed already. Uncompressed pixels become 10 times smaller, and masks
# 100 times, but they are a small part of the whole.
_MOST_RATIO = 100
_ALWAYS_ALLOWED = 64 << 20  # bytes, unpacked
_LONGEST_DIRECTORY = 32 << 20  # bytes of the list of files; Python needs ten times as much memory
_MOST_FILES = 200_000
_TAIL = 22 + 0xFFFF + 76  # bytes: the end of the list, with the longest comment


def is_zip(path: Path) -> bool:
    """Whether a file is a zip file. Documents and scenes with other suffixes may be zip files too.

    Raises: OSError: the file cannot be read.
    """
    return path.suffix.lower() == ".zip" and path.is_file() and _head(path).startswith(_ZIP)


def other_archive(path: Path) -> str | None:
    """The format of a file that is another kind of archive, e.g. RAR."""
    head = _head(path)
    return next((name for start, name in _OTHERS.items() if head.startswith(start)), None)


def _head(path: Path) -> bytes:
    with open(path, "rb") as file:
        return file.read(8)


def files_in(path: Path) -> list[str]:
    """The names of the files in a zip file, with "/". Hidden files are left out.

    Raises: UserError: as `unpack`, as far as the list of files shows it.
    """
    with _open_zip(path) as archive:
        return [name for name, _ in _check_entries(archive, path)]


def unpack(path: Path) -> Path:
    """Unpack a zip file into a folder beside it with its name; returns the folder.

    If this folder has these files already, it is used as it is. If it has others, the new folder is
    called ``NAME_unpacked``.

    Raises: UserError: the file is damaged, empty or has a password; a file in it has a path outside
    of the folder; or the folder cannot be written.
    """
    with _open_zip(path) as archive:
        entries = _check_entries(archive, path)
        if not entries:
            raise UserError(
                "{path}: has no files; copy it again, or use another file", path=shown(path)
            )
        for folder in (path.with_suffix(""), path.with_name(f"{path.stem}_unpacked")):
            if _has_all(folder, entries):
                return folder
            if not folder.exists():
                _extract_all(archive, entries, folder)
                return folder
        raise UserError(
            "{path}: cannot be unpacked, because {folder} has other files; remove it",
            path=shown(path),
            folder=shown(folder),
        )


@contextmanager
def _open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """A zip file. Raises UserError if it cannot be read, here or in the block."""
    try:
        if _directory_bytes(path) > _LONGEST_DIRECTORY:
            raise UserError("{path}: has too many files; unpack it first", path=shown(path))
        with zipfile.ZipFile(path) as archive:
            yield archive
    except UserError:
        raise
    except Exception as error:  # zipfile raises many kinds of exceptions for damaged files
        reason = as_message(error)
        if isinstance(error, OSError):
            reason = cause_of(error)
        elif not isinstance(error, Problem):
            reason = Message(" ".join(str(error).split())[:80]) or message("it is damaged")
        raise UserError(
            "{path}: cannot be unpacked ({reason}); copy it again, or unpack it to a folder",
            path=shown(path),
            reason=reason,
        ) from None


def _directory_bytes(path: Path) -> int:
    """The length of the list of files, as the end of the zip file says it."""
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        tail = file.read()
    end = tail.rfind(b"PK\x05\x06")
    if not 0 <= end <= len(tail) - 22:
        raise Problem("it is truncated")
    (length,) = struct.unpack_from("<I", tail, end + 12)
    large = tail.rfind(b"PK\x06\x06")
    if length == 0xFFFFFFFF and 0 <= large <= len(tail) - 56:
        (length,) = struct.unpack_from("<Q", tail, large + 40)
    return int(length)


def _check_entries(archive: zipfile.ZipFile, path: Path) -> list[tuple[str, zipfile.ZipInfo]]:
    """The files that are not hidden, with a name relative to the new folder."""
    entries: dict[str, tuple[str, zipfile.ZipInfo]] = {}
    for info in archive.infolist():
        name = info.filename.replace("\\", "/")  # some programs for Windows write it
        pure = PurePosixPath(name)
        if pure.is_absolute() or ".." in pure.parts or ":" in name.partition("/")[0]:
            raise UserError(
                "{path}: has a file outside of its folder: {name}",
                path=shown(path),
                name=shown(name)[:80],
            )
        kind = stat.S_IFMT(info.external_attr >> 16)
        hidden = any(part.startswith(".") or part == "__MACOSX" for part in pure.parts)
        if name.endswith("/") or hidden or not pure.parts or kind not in (0, stat.S_IFREG):
            continue  # a folder, or a link
        if info.flag_bits & 1:
            raise UserError("{path}: has a password; unpack it first", path=shown(path))
        number = 1
        while str(pure).casefold() in entries:
            number += 1
            pure = pure.with_name(f"{PurePosixPath(name).stem}_{number}{pure.suffix}")
        entries[str(pure).casefold()] = (str(pure), info)
    size = sum(info.file_size for _, info in entries.values())
    if len(entries) > _MOST_FILES or size > max(_ALWAYS_ALLOWED, _MOST_RATIO * path.stat().st_size):
        raise UserError(
            "{path}: would become {entries:,} files of {size:,.1f} GB; if that is right, unpack "
            "it first",
            path=shown(path),
            entries=len(entries),
            size=size / 1000000000.0,
        )
    return list(entries.values())


def _has_all(folder: Path, entries: Sequence[tuple[str, zipfile.ZipInfo]]) -> bool:
    """Whether a folder has these files and, except for hidden ones, no others."""
    files = ((folder / name, info.file_size) for name, info in entries)
    if not all(file.is_file() and file.stat().st_size == size for file, size in files):
        return False
    there = (name for _, _, names in os.walk(folder) for name in names if name[0] != ".")
    return sum(1 for _ in there) == len(entries)


def _extract_all(
    archive: zipfile.ZipFile, entries: Sequence[tuple[str, zipfile.ZipInfo]], folder: Path
) -> None:
    with new_entries(folder.parent, [folder.name]) as new:
        for name, info in entries:
            target = new / folder.name / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(info) as packed, open(target, "xb") as file:
                shutil.copyfileobj(packed, file)
