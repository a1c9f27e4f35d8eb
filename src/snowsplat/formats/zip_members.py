"""The members of an untrusted zip file, unpacked in memory, never to the disk."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from snowsplat.formats.damage import Damaged
from snowsplat.util.errors import cause_of
from snowsplat.util.safe_json import is_file, quoted

# Largest directory in bytes. Python creates an object for each entry, ten times as large as it.
_DIRECTORY_LIMIT = 1 << 20
_BLOCK = 1 << 16
# Maximum size of an unpacked member: a factor times its packed size, plus this many bytes.
_INFLATION_FREE = 1 << 20
# What `zipfile` raises for damaged files. OverflowError: an offset larger than that of any file.
_ERRORS = (
    OSError,
    ValueError,
    RuntimeError,
    OverflowError,
    EOFError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


@contextmanager
def reading_file(path: Path) -> Iterator[None]:
    """Context for reading a file: raises `Damaged` if it is no file, or instead of `OSError`."""
    try:
        if not is_file(path):  # reading a pipe may never end
            raise Damaged("{name} is missing or not a file", name=quoted(path.name))
        yield
    except OSError as error:
        raise Damaged(
            "{name} cannot be read ({strerror})", name=path.name, strerror=cause_of(error)
        ) from None


class ZipMembers:
    """The members of a zip file. A context manager."""

    def __init__(self, path: Path) -> None:
        """Raises: Damaged: not a zip file, or one with an implausible directory."""
        with reading_file(path):
            self._file = _InBlocks(path)
        try:
            self._zip = zipfile.ZipFile(self._file)
        except _ERRORS:
            raise Damaged("not a readable zip file") from None

    def __enter__(self) -> ZipMembers:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()
        self._file.close()

    def names(self) -> list[str]:
        """The names of all members. They are not safe as paths."""
        return self._zip.namelist()

    def read(self, name: str, inflation: int) -> bytes:
        """The content of a member, at most ``inflation`` times as large as it is packed.

        Raises: Damaged: it is missing, damaged, or larger than that.
        """
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise Damaged("a zip file without {name}", name=quoted(name)) from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Damaged(
                "its {name} has an unknown compression method; unzip it", name=quoted(name)
            )
        packed = min(info.compress_size, self._file.size)
        if info.file_size > inflation * packed + _INFLATION_FREE:
            raise Damaged(
                "its {name} would unpack to {file_size} bytes",
                name=quoted(name),
                file_size=info.file_size,
            )
        try:
            content = bytearray()
            with self._zip.open(info) as member:
                # read() without a size would unpack everything, whatever size is declared.
                while block := member.read(min(_BLOCK, info.file_size - len(content))):
                    content += block
            return bytes(content)
        except _ERRORS:
            raise Damaged("its {name} is damaged", name=quoted(name)) from None


class _InBlocks(io.FileIO):
    """A file that refuses to read much at once: `zipfile` reads a directory of any size."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        wanted = self.size - self.tell() if size is None or size < 0 else size
        if wanted > _DIRECTORY_LIMIT:
            raise Damaged("a zip file with an implausible number of members")
        return super().read(size)
