"""The members of a SOG scene: a zip file, or a folder beside its `meta.json`.

Trusts no size that the file declares before the file can account for it, and no name: members of a
zip are only ever looked up, and a folder is not left.
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
_INFLATION, _INFLATION_FREE = 4, 1 << 20  # WebP does not deflate by much


class Damaged(Exception):
    """What is wrong with the scene; its name is put before it further up."""


class Bundle:
    """The members of a bundle or of a folder. Context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._meta = self._file(path)
        self.size = len(self._meta)
        self._zip: zipfile.ZipFile | None = None
        if self._meta.startswith(b"PK"):
            # Python makes an object of each entry, which takes ten times as much as the entry.
            if self._meta.count(b"PK\x01\x02") > _MOST_MEMBERS:
                raise Damaged("a zip file of absurdly many parts")
            try:
                self._zip = zipfile.ZipFile(io.BytesIO(self._meta))
            except (ValueError, EOFError, struct.error, NotImplementedError, zipfile.BadZipFile):
                raise Damaged("cannot be read as a zip file") from None

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def meta(self) -> dict[str, Any]:
        """`meta.json`."""
        data = self._member("meta.json") if self._zip else self._meta
        try:
            meta = parse_json(data)
        except ValueError:
            meta = None
        if not isinstance(meta, dict):
            raise Damaged("has a meta.json that is not JSON")
        return meta

    def picture(self, name: str, least: int, most: int) -> np.ndarray:
        """(H, W, 4) uint8 of so many pixels."""
        data = self._member(name) if self._zip is not None else self._file(self._beside(name))
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                width, height = image.size
                if least <= width * height <= most:
                    return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise Damaged(f"has a picture that cannot be read, {name} ({error})") from None
        raise Damaged(f"has a picture of {width}×{height} pixels where {least} are meant, {name}")

    def bytes_with(self, names: Iterable[str]) -> int:
        """How large the scene is with these members: of a bundle, the whole file."""
        if self._zip is not None:
            return self.size
        found = [path for path in {self._beside(name) for name in names} if is_file(path)]
        return self.size + sum(path.stat().st_size for path in found)

    def _beside(self, name: str) -> Path:
        if not name or Path(name).name != name:  # nothing outside the folder
            raise Damaged(f"names a picture outside its folder ({quoted(name)})")
        return self._path.parent / name

    def _member(self, name: str) -> bytes:
        assert self._zip is not None
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise Damaged(f"a zip file, but without {name!r}") from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Damaged(f"holds {name} packed in a way that SOG does not use")
        if info.file_size > _INFLATION * min(info.compress_size, self.size) + _INFLATION_FREE:
            raise Damaged(f"holds {name}, which would unpack to {info.file_size} bytes")
        try:
            with self._zip.open(info) as member:
                # Not read(), which unpacks all there is, whatever the size that is declared.
                return member.read(info.file_size)
        except (
            OSError,
            ValueError,
            RuntimeError,
            OverflowError,  # a place that no file reaches
            EOFError,
            struct.error,
            zipfile.BadZipFile,
            zlib.error,
        ):
            raise Damaged(f"holds a damaged {name}") from None

    def _file(self, path: Path) -> bytes:
        try:
            if not is_file(path):  # a pipe never ends
                raise Damaged(f"{quoted(path.name)} is absent, or no file")
            return path.read_bytes()
        except OSError as error:
            raise Damaged(f"{path.name} cannot be read ({error.strerror or error})") from None
