"""The members of a SOG scene: a zip file, or a folder with a `meta.json`.

Declared sizes are compared with the size of the file before memory is allocated. Names are not
trusted: a name in a zip file is never used as a path, and a file outside of the folder is refused.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.formats.damage import Damaged
from snowsplat.formats.zip_members import ZipMembers, reading_file
from snowsplat.util.safe_json import is_file, parse_json, quoted

# WebP images are already compressed, so the zip compression hardly reduces them.
_MOST_INFLATION = 4


def meta_folder(names: Iterable[str]) -> str | None:
    """The folder of the only ``meta.json`` of a zip file, with "/", or ""; None: there is none."""
    found = [name for name in names if PurePosixPath(name).name == "meta.json"]
    own = [name for name in found if not name.startswith("__MACOSX/")]
    return own[0].removesuffix("meta.json") if len(own) == 1 else None


class Bundle:
    """The members of a zip file or of a folder. A context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._zip: ZipMembers | None = None
        with reading_file(path):
            with open(path, "rb") as file:
                zipped = file.read(2) == b"PK"
            self.size = path.stat().st_size
        self._folder = ""
        if zipped:
            self._zip = ZipMembers(path)
            self._folder = meta_folder(self._zip.names()) or ""

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.__exit__()

    def meta(self) -> dict[str, Any]:
        """The content of `meta.json`. Raises: Damaged: it is missing, or not a JSON object."""
        data = self._member("meta.json") if self._zip else self._file(self._path)
        try:
            meta = parse_json(data)
        except ValueError:
            meta = None
        if not isinstance(meta, dict):
            raise Damaged("its meta.json is not valid JSON")
        return meta

    def image(self, name: str, least: int, most: int) -> np.ndarray:
        """The image ``name``, (H, W, 4) uint8, with ``least`` to ``most`` pixels.

        Raises: Damaged: it is missing, cannot be read, or has another number of pixels.
        """
        data = self._member(name) if self._zip is not None else self._file(self._beside(name))
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                width, height = image.size
                if least <= width * height <= most:
                    return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise Damaged(
                "its image {name} cannot be read ({error})", name=name, error=error
            ) from None
        raise Damaged(
            "its image {name} has {width}×{height} pixels; expected {least}",
            name=name,
            width=width,
            height=height,
            least=least,
        )

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
            raise Damaged("refers to an image outside of its folder ({name})", name=quoted(name))
        return self._path.parent / name

    def _member(self, name: str) -> bytes:
        assert self._zip is not None
        return self._zip.read(self._folder + name, _MOST_INFLATION)

    def _file(self, path: Path) -> bytes:
        with reading_file(path):
            return path.read_bytes()
