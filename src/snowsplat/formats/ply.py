"""PLY files: scenes in the layout of the 3DGS reference implementation.

A scene of SH degree 3 has 62 float properties per Gaussian, in this order: x y z, nx ny nz (zeros),
f_dc_0..2, f_rest_0..44, opacity, scale_0..2, rot_0..3. Values are the optimised parameters, before
their activations: opacity is a logit, scale a natural logarithm, rot a quaternion wxyz of any
length. f_rest is channel-major: all K coefficients of red, then of green, then of blue (`sh_rest`
of `GaussianArrays` is (N, K, 3)). Lower degrees have fewer f_rest properties.

A comment in the header says how an antialiased scene is rendered: "SplatRenderMode: mip", which
Brush introduced. Postshot writes "antialiased 1" or "postshot.anti_aliasing=1".
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.ply import PlyTable, header, open_table

_WRITE_ROWS = 1 << 14


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(3 * count)]


_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]
#: Comments in lower case, and whether the scene is antialiased.
_MODES = {
    "splatrendermode: mip": True,
    "splatrendermode: default": False,
    "antialiased 1": True,
    "antialiased 0": False,
    "postshot.anti_aliasing=1": True,
    "postshot.anti_aliasing=0": False,
}
_REQUIRED = [*_MEANS, *_DC, "opacity", *_SCALES, *_QUATS]


def is_ply(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a PLY file, with any content."""
    return head.startswith((b"ply\n", b"ply\r\n"))


def is_scene(table: PlyTable) -> bool:
    """Whether the table has the columns of Gaussians; if not, it may be a point cloud."""
    return all(name in table.columns for name in _REQUIRED)


def read_ply(path: Path | str) -> GaussianArrays:
    """Read a scene of any SH degree.

    The properties may have any order and any type. Unknown properties are ignored. Values are not
    changed: NaN and infinity are read as they are.

    Raises:
        UserError: the file is missing, damaged, truncated, or a PLY file without Gaussians.
    """
    table = open_table(path)
    if not is_scene(table):
        missing = [name for name in _REQUIRED if name not in table.columns]
        shown = ", ".join(missing[:4]) + (", …" if len(missing) > 4 else "")
        raise UserError(f"{path}: a PLY file without 3D Gaussians; missing properties: {shown}")
    rest = [name for name in table.columns if name.startswith("f_rest_")]
    if (
        len(rest) % 3
        or len(rest) // 3 not in SH_REST_COUNTS
        or set(rest) != set(_rest_names(len(rest) // 3))
    ):
        raise UserError(
            f"{path}: {len(rest)} f_rest properties do not match an SH degree; "
            "expected 0, 9, 24 or 45, numbered from 0"
        )
    k = len(rest) // 3

    n = table.count
    means = np.empty((n, 3), np.float32)
    log_scales = np.empty((n, 3), np.float32)
    quats = np.empty((n, 4), np.float32)
    opacity_logits = np.empty(n, np.float32)
    sh_dc = np.empty((n, 1, 3), np.float32)
    sh_rest = np.empty((n, k, 3), np.float32)
    columns: list[tuple[str, np.ndarray]] = [
        *zip(_MEANS, means.T, strict=True),
        *zip(_DC, sh_dc[:, 0].T, strict=True),
        ("opacity", opacity_logits),
        *zip(_SCALES, log_scales.T, strict=True),
        *zip(_QUATS, quats.T, strict=True),
        *zip(_rest_names(k), (sh_rest[:, i, c] for c in range(3) for i in range(k)), strict=True),
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinity
        for start, rows in table.rows():
            for name, target in columns:
                target[start : start + len(rows)] = rows[name]
    arrays = (means, log_scales, quats, opacity_logits, sh_dc, sh_rest)
    return GaussianArrays(*arrays, antialiased=is_antialiased(table.comments))


def is_antialiased(comments: Sequence[str]) -> bool:
    """Whether the last comment that names a mode of rendering names the antialiased one."""
    marks = [_MODES[line] for line in map(str.lower, comments) if line in _MODES]
    return bool(marks) and marks[-1]


def mode_comments(antialiased: bool) -> list[str]:
    """The comments of a header for `is_antialiased`; a scene in the usual mode needs none."""
    return ["SplatRenderMode: mip"] if antialiased else []


def write_ply(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write the layout above, binary little-endian, atomically.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full.
    """
    count, rest = len(gaussians.means), gaussians.sh_rest.shape[1]
    write_ply_parts(path, count, rest, [gaussians], antialiased=gaussians.antialiased)


def write_ply_parts(
    path: Path | str,
    count: int,
    rest: int,
    parts: Iterable[GaussianArrays],
    *,
    antialiased: bool,
) -> None:
    """`write_ply` for a scene that does not fit into the memory: its parts one after the other.

    Args:
        count: number of Gaussians of all parts.
        rest: K, the number of SH coefficients beyond the constant one; parts may have fewer.
        antialiased: whether the scene is marked as `Gaussians.antialiased`.

    Raises:
        OSError: see `write_ply`.
    """
    names = [*_MEANS, *_NORMALS, *_DC, *_rest_names(rest), "opacity", *_SCALES, *_QUATS]
    written = 0
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        properties = [("float", name) for name in names]
        file.write(header(count, properties, mode_comments(antialiased)))
        for part in parts:
            for start in range(0, len(part.means), _WRITE_ROWS):
                rows = part.select(slice(start, start + _WRITE_ROWS))
                file.write(_table(rows, rest).tobytes())
            written += len(part.means)
        assert written == count


def _table(gaussians: GaussianArrays, rest: int) -> np.ndarray:
    """(N, columns) the rows of the file; SH coefficients that are missing are zeros."""
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = gaussians
    n, k = sh_rest.shape[:2]
    rows = np.zeros((n, 17 + 3 * rest), "<f4")
    rows[:, 0:3] = means
    rows[:, 6:9] = sh_dc[:, 0]
    by_channel = rows[:, 9 : 9 + 3 * rest].reshape(n, 3, rest)
    by_channel[..., :k] = sh_rest.transpose(0, 2, 1)
    rows[:, 9 : 9 + 3 * rest] = by_channel.reshape(n, 3 * rest)
    rows[:, -8] = opacity_logits
    rows[:, -7:-4] = log_scales
    rows[:, -4:] = quats
    return rows
