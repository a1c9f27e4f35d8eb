"""Reads normal maps from files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.data.maps.map_file import read_map
from snowsplat.util.errors import UserError

#: A vector whose length differs more from 1 is no normal: a background, or a blurred edge.
_LENGTH_ERROR = 0.1
#: The largest share of such pixels in a normal map; pixels of black, white and zeros do not count.
_MOST_OTHERS = 0.5


def read_normal_file(path: Path) -> np.ndarray:
    """The normals of a map, (H, W, 3) float32 of length 1; NaN where the map has none.

    Reads PNG and TIFF files of 8 or 16 bits (of 16, the upper 8 are used), where 0 is -1 and the
    largest value 1; NPY files, (H, W, 3) or (3, H, W), of such integers or of floats in -1..1 or
    0..1; and EXR files with the channels R, G, B or X, Y, Z. The axes are those of the file.

    Raises:
        UserError: the file is missing, damaged, has no known suffix, or its values are not normals.
    """
    stored = read_map(path, "normal map", _channels)
    values = np.squeeze(stored)
    if values.ndim == 3 and values.shape[2] not in (3, 4) and values.shape[0] in (3, 4):
        values = values.transpose(1, 2, 0)
    if values.ndim != 3 or values.shape[2] not in (3, 4) or values.dtype.kind not in "fu":
        raise UserError(
            "{path}: has the shape {shape} and the type {dtype}; a normal map has three numbers "
            "per pixel",
            path=path,
            shape=stored.shape,
            dtype=stored.dtype,
        )
    values = values[..., :3]
    if values.dtype.kind == "u":
        scaled = values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
        normals = 2.0 * scaled - 1.0
    else:
        scaled = values.astype(np.float32)
        finite = np.isfinite(scaled)
        # Normals of all directions towards a camera have negative components in any frame.
        normals = 2.0 * scaled - 1.0 if (scaled[finite] >= 0.0).all() else scaled
    length = np.sqrt((normals * normals).sum(-1, keepdims=True))
    with np.errstate(invalid="ignore"):
        known = np.abs(length - 1.0) <= _LENGTH_ERROR
    marked = (scaled == 0.0).all(-1) | (scaled == 1.0).all(-1) | ~np.isfinite(length[..., 0])
    others = int((~known[..., 0] & ~marked).sum())
    if others > _MOST_OTHERS * (others + int(known.sum())):
        raise UserError(
            "{path}: its values are not normals: {size:.0f}% of the pixels have another length "
            "than 1; export x, y and z as red, green and blue",
            path=path,
            size=100 * others / known.size,
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known, normals / length, np.float32(np.nan)).astype(np.float32)


def _channels(channels: Mapping[str, Any]) -> np.ndarray:
    """The normals among the channels of an EXR file."""
    for name in ("RGB", "RGBA"):
        if name in channels:
            return np.asarray(channels[name])
    names = "XYZ" if "X" in channels else "RGB"
    return np.stack([np.asarray(channels[name]) for name in names], -1)
