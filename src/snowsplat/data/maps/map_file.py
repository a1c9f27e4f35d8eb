"""Reads the values of maps that belong to photos, such as depths and normals, from files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.data.photos.image_file import MOST_PIXELS, TOO_LARGE, open_image, reason_of
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.safe_json import is_file

#: Suffixes of the files that `read_map` reads.
MAP_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")

#: Takes the channels of an EXR file by name, and returns the map; a KeyError if there is none.
Pick = Callable[[Mapping[str, Any]], np.ndarray]


def read_map(path: Path, kind: str, pick: Pick) -> np.ndarray:
    """The values of a map, as stored, in an array of any shape and dtype.

    Args:
        path: PNG, TIFF, NPY, or EXR, which needs the package OpenEXR.
        kind: of the map, for messages, as "depth map".

    Raises:
        UserError: the file is missing, damaged or too large, or has no known suffix.
    """
    if not is_file(path):
        raise UserError("{path}: no such {kind}", path=path, kind=kind)
    suffix = path.suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise UserError(
            "{path}: unknown kind of {kind}; use {map_suffixes}",
            path=path,
            kind=kind,
            map_suffixes=", ".join(MAP_SUFFIXES),
        )
    try:
        if suffix == ".npy":
            return _read_npy(path)
        if suffix == ".exr":
            return _read_exr(path, pick)
        with open_image(path, ("PNG", "TIFF")) as image:
            if image.mode == "P":
                raise Problem("it has a palette of colours; save the values")
            return np.asarray(image)
    except UserError:
        raise
    except Exception as error:  # each of these libraries raises many kinds of exceptions
        raise UserError(
            "{path}: cannot be read as a {kind} ({reason_of}); export it again",
            path=path,
            kind=kind,
            reason_of=reason_of(error),
        ) from None


def _read_npy(path: Path) -> np.ndarray:
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    if values.size > 3 * MOST_PIXELS:
        raise Problem(TOO_LARGE)
    return np.array(values)


def _read_exr(path: Path, pick: Pick) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError:
        raise UserError(
            "{path}: EXR files need a package; run pip install OpenEXR, or convert it to NPY",
            path=path,
        ) from None
    with OpenEXR.File(str(path), header_only=True) as header:
        box = header.header()["dataWindow"]
        width, height = (int(high - low) + 1 for low, high in zip(*box, strict=True))
        if width * height > MOST_PIXELS:
            raise Problem(TOO_LARGE)
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        try:
            return np.array(pick({name: channel.pixels for name, channel in channels.items()}))
        except KeyError as error:
            raise Problem(
                "no channel {args}, but {channels}",
                args=error.args[0],
                channels=", ".join(channels),
            ) from None
