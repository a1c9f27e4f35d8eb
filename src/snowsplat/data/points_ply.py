"""Reading and writing coloured point clouds as PLY files."""

from pathlib import Path

import numpy as np

from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.ply import header_of, open_table

_POSITION = ["x", "y", "z"]
_NORMAL = ["nx", "ny", "nz"]
_RGB = ["red", "green", "blue"]
_POINT = np.dtype([(name, "<f4") for name in _POSITION + _NORMAL] + [(name, "u1") for name in _RGB])


def write_points(path: Path | str, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write a point cloud atomically: ``xyz`` (P, 3) float, ``rgb`` (P, 3) uint8.

    The normals (nx, ny, nz) are 0.

    Raises: OSError: the folder is missing or not writable, or the disk is full.
    """
    rows = np.zeros(len(xyz), _POINT)
    for column, name in enumerate(_POSITION):
        rows[name] = xyz[:, column]
    for column, name in enumerate(_RGB):
        rows[name] = rgb[:, column]
    kinds = [
        ("uchar" if _POINT[name] == np.uint8 else "float", name) for name in _POINT.names or ()
    ]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(header_of([("vertex", len(rows), kinds)]))
        file.write(rows.tobytes())


def read_points(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Read a point cloud: xyz (P, 3) float32, or float64 as in the file, and rgb (P, 3) uint8.

    Floating-point colours are expected in 0..1. Without colours, all points are grey (128).

    Raises: UserError: the file is missing, damaged, truncated, or has no columns x, y, z.
    """
    table = open_table(path)
    if not all(name in table.columns for name in _POSITION):
        raise UserError("{path}: not a point cloud; the PLY file needs columns x, y, z", path=path)
    double = any(np.dtype(table.columns[name]) == np.float64 for name in _POSITION)
    xyz = np.empty((table.count, 3), np.float64 if double else np.float32)
    rgb = np.full((table.count, 3), 128, np.uint8)
    colors = [name for name in _RGB if name in table.columns]
    with np.errstate(over="ignore", invalid="ignore"):
        for start, rows in table.rows():
            part = slice(start, start + len(rows))
            for column, name in enumerate(_POSITION):
                xyz[part, column] = rows[name]
            if len(colors) == 3:
                for column, name in enumerate(colors):
                    values = rows[name]
                    if values.dtype.kind == "f":
                        values = np.nan_to_num(values.astype(np.float32)) * 255.0 + 0.5
                    rgb[part, column] = np.clip(values, 0, 255)
    return xyz, rgb
