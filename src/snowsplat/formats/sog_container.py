"""The members of a SOG scene: a zip file, or a folder with a `meta.json`.

Declared sizes are compared with the size of the file before memory is allocated. Names are not
trusted: a name in a zip file is never used as a path, and a file outside of the folder is refused.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.util.safe_json import is_file, parse_json, quoted

_MOST_MEMBERS = 1000
# Maximum size of an unpacked member: _MOST_INFLATION times its packed size, plus _INFLATION_FREE
# bytes. WebP images are already compressed, so the zip compression hardly reduces them.
_MOST_INFLATION = 4
_INFLATION_FREE = 1 << 20


class Damaged(Exception):
    """The scene is damaged. The caller adds the path to the message."""


class Bundle:
    """The members of a zip file or of a folder. A context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._meta = self._file(path)
        self.size = len(self._meta)
        self._zip: zipfile.ZipFile | None = None
        if self._meta.startswith(b"PK"):
            # Python creates an object for each entry, ten times as large as the entry.
            if self._meta.count(b"PK\x01\x02") > _MOST_MEMBERS:
                raise Damaged("a zip file with an implausible number of members")
            try:
                self._zip = zipfile.ZipFile(io.BytesIO(self._meta))
            except (ValueError, EOFError, struct.error, NotImplementedError, zipfile.BadZipFile):
                raise Damaged("not a readable zip file") from None

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def meta(self) -> dict[str, Any]:
        """The content of `meta.json`.

        Raises:
            Damaged: it is missing, or not a JSON object.
        """
        data = self._member("meta.json") if self._zip else self._meta
        try:
            meta = parse_json(data)
        except ValueError:
            meta = None
        if not isinstance(meta, dict):
            raise Damaged("its meta.json is not valid JSON")
        return meta

    def image(self, name: str, least: int, most: int) -> np.ndarray:
        """The image ``name``, (H, W, 4) uint8, with ``least`` to ``most`` pixels.

        Raises:
            Damaged: it is missing, cannot be read, or has another number of pixels.
        """
        data = self._member(name) if self._zip is not None else self._file(self._beside(name))
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                width, height = image.size
                if least <= width * height <= most:
                    return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise Damaged(f"its image {name} cannot be read ({error})") from None
        raise Damaged(f"its image {name} has {width}×{height} pixels; expected {least}")

    def bytes_with(self, names: Iterable[str]) -> int:
        """Number of bytes of these members of a folder; for a zip file, the size of the file."""
        return self.size + sum(path.stat().st_size for path in self.beside(names))

    def beside(self, names: Iterable[str]) -> list[Path]:
        """The files of these members of a folder, as far as they exist; none for a zip file."""
        if self._zip is not None:
            return []
        return [path for path in sorted({self._beside(name) for name in names}) if is_file(path)]

    def _beside(self, name: str) -> Path:
        if not name or Path(name).name != name:
            raise Damaged(f"refers to an image outside of its folder ({quoted(name)})")
        return self._path.parent / name

    def _member(self, name: str) -> bytes:
        assert self._zip is not None
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise Damaged(f"a zip file without {name!r}") from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Damaged(f"its {name} has a compression method that SOG does not use")
        if info.file_size > _MOST_INFLATION * min(info.compress_size, self.size) + _INFLATION_FREE:
            raise Damaged(f"its {name} would unpack to {info.file_size} bytes")
        try:
            with self._zip.open(info) as member:
                # read() without a size would unpack everything, whatever size is declared.
                return member.read(info.file_size)
        except (
            OSError,
            ValueError,
            RuntimeError,
            OverflowError,  # an offset larger than that of any file
            EOFError,
            struct.error,
            zipfile.BadZipFile,
            zlib.error,
        ):
            raise Damaged(f"its {name} is damaged") from None

    def _file(self, path: Path) -> bytes:
        try:
            if not is_file(path):  # reading a pipe may never end
                raise Damaged(f"{quoted(path.name)} is missing or not a file")
            return path.read_bytes()
        except OSError as error:
            raise Damaged(f"{path.name} cannot be read ({error.strerror or error})") from None
