"""Files that `static_app` serves: in memory or on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

_BLOCK = 1 << 18  # bytes sent at once


@dataclass(frozen=True)
class ServedFile:
    """A file's bytes and its content type."""

    content: bytes = field(repr=False)
    type: str

    @property
    def size(self) -> int:
        return len(self.content)

    @cached_property
    def etag(self) -> str:
        return f'"{hashlib.sha256(self.content).hexdigest()[:32]}"'

    def blocks(self, start: int, end: int) -> Iterator[memoryview]:
        """The bytes from ``start`` to ``end`` in small blocks."""
        content = memoryview(self.content)
        for at in range(start, end, _BLOCK):
            yield content[at : min(at + _BLOCK, end)]


@dataclass(frozen=True)
class FileOnDisk:
    """A file that is read when it is requested; it must not change while it is served."""

    path: Path
    type: str

    @cached_property
    def size(self) -> int:
        return self.path.stat().st_size

    @cached_property
    def etag(self) -> str:
        return f'"{self.path.stat().st_mtime_ns:x}-{self.size:x}"'

    def blocks(self, start: int, end: int) -> Iterator[bytes]:
        """The same as `ServedFile.blocks`. Raises: ConnectionError: the file is shorter now."""
        with open(self.path, "rb") as file:
            file.seek(start)
            for at in range(start, end, _BLOCK):
                block = file.read(min(_BLOCK, end - at))
                if len(block) < min(_BLOCK, end - at):
                    raise ConnectionError(f"{self.path}: is shorter than before")
                yield block


Served = ServedFile | FileOnDisk

_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".mp4": "video/mp4",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".webp": "image/webp",
}


def content_type(file: Path) -> str:
    """The content type of a file, by its suffix."""
    return _TYPES.get(file.suffix, "application/octet-stream")


def served(folder: Path, files: Iterable[Path]) -> dict[str, Served]:
    """Files in a folder, by their quoted paths in it."""
    return {
        quote(file.relative_to(folder).as_posix()): FileOnDisk(file, content_type(file))
        for file in files
    }
