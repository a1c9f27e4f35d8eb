"""The members of a SOG scene: a zip file, or a folder beside its `meta.json`.

Trusts no size that the file declares before the file can account for it, and no name: members of a
zip are only ever looked up, and a folder is not left.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_META_LIMIT = 16 << 20
_INFLATION, _INFLATION_FREE = 4, 1 << 20  # WebP does not deflate by much


class Damaged(Exception):
    """What is wrong with the scene; its name is put before it further up."""


class Bundle:
    """The members of a bundle or of a folder. Context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with open(path, "rb") as file:
                bundled = file.read(2) == b"PK"
            self._zip = zipfile.ZipFile(path) if bundled else None
            self.size = path.stat().st_size
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise Damaged(f"cannot be read as a zip file ({error})") from None

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def meta(self) -> dict[str, Any]:
        """`meta.json`."""
        data = self._member("meta.json") if self._zip else self._file(self._path)
        if len(data) > _META_LIMIT:
            raise Damaged("has a meta.json that is far too large")
        try:
            meta = json.loads(data)
        except (ValueError, RecursionError):
            meta = None
        if not isinstance(meta, dict):
            raise Damaged("has a meta.json that is not JSON")
        return meta

    def picture(self, name: str, least: int, most: int) -> np.ndarray:
        """(H, W, 4) uint8 of so many pixels."""
        if self._zip is not None:
            data = self._member(name)
        elif Path(name).name == name:  # nothing outside the folder
            data = self._file(self._path.parent / name)
            self.size += len(data)
        else:
            raise Damaged(f"names a picture outside its folder ({name!r})")
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                width, height = image.size
                if least <= width * height <= most:
                    return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise Damaged(f"has a picture that cannot be read, {name} ({error})") from None
        raise Damaged(f"has a picture of {width}×{height} pixels where {least} are meant, {name}")

    def _member(self, name: str) -> bytes:
        assert self._zip is not None
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise Damaged(f"a zip file, but without {name!r}") from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Damaged(f"holds {name} packed in a way that SOG does not use")
        if info.file_size > _INFLATION * info.compress_size + _INFLATION_FREE:
            raise Damaged(f"holds {name}, which would unpack to {info.file_size} bytes")
        try:
            return self._zip.read(info)  # never more than it declares
        except (
            OSError,
            ValueError,
            RuntimeError,
            EOFError,
            zipfile.BadZipFile,
            zlib.error,
        ):
            raise Damaged(f"holds a damaged {name}") from None

    def _file(self, path: Path) -> bytes:
        try:
            return path.read_bytes()
        except OSError as error:
            raise Damaged(f"{path.name} cannot be read ({error.strerror or error})") from None
