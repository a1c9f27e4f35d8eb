"""PLY files: scenes in the layout of the 3DGS reference implementation, and its relatives.

A scene of SH degree 3 has 62 float properties per Gaussian, in this order: x y z, nx ny nz (zeros),
f_dc_0..2, f_rest_0..44, opacity, scale_0..2, rot_0..3. Values are the optimised parameters, before
their activations: opacity is a logit, scale a natural logarithm, rot a quaternion wxyz of any
length. f_rest is channel-major: all K coefficients of red, then of green, then of blue (`sh_rest`
of `GaussianArrays` is (N, K, 3)). Lower degrees have fewer f_rest properties.

A comment in the header says how an antialiased scene is rendered: "SplatRenderMode: mip", which
Brush introduced. Postshot writes "antialiased 1" or "postshot.anti_aliasing=1". The comment
"origin X Y Z" has the `scene.origin` of a scene that is far away from 0, "metres_per_unit F" its
true scale.

Other trainers write the same layout with differences that are understood: SH of degree 4 and higher
(gsplat, 3DGRUT), two scales (2D Gaussian splatting), filter_3D (Mip-Splatting), and red, green,
blue in place of f_dc.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from snowsplat.formats.damage import Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, float32_gaussians, unusable
from snowsplat.formats.packing import FLAT
from snowsplat.scene.length import stored_metres
from snowsplat.scene.origin import HERE, Origin, add_origins, stored_origin
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS
from snowsplat.util.files import atomic_path
from snowsplat.util.names import first_names
from snowsplat.util.ply import PlyTable, header_of, open_table

logger = logging.getLogger(__name__)

_WRITE_ROWS = 1 << 14


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(3 * count)]


_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_RGB = ["red", "green", "blue"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_FILTER = "filter_3D"
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
_REQUIRED = [*_MEANS, *_DC, "opacity", *_SCALES[:2], *_QUATS]
_ORIGIN, _METRES = "origin ", "metres_per_unit "
_HIGHEST_DEGREE = 10
#: A comment of nerfstudio. Here, as in most files, y points down.
_Z_UP = "vertical axis: z"


def is_ply(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a PLY file, with any content."""
    return head.startswith((b"ply\n", b"ply\r\n"))


def is_scene(table: PlyTable) -> bool:
    """Whether the table has the columns of Gaussians; if not, it may be a point cloud."""
    return not _missing(table)


def _missing(table: PlyTable) -> list[str]:
    """The required columns that the table does not have. Colours can replace f_dc."""
    colored = all(name in table.columns for name in _RGB)
    missing = [name for name in _REQUIRED if name not in table.columns]
    return [name for name in missing if not (colored and name in _DC)]


@reads
def read_ply(path: Path, data: bytes | None = None) -> GaussianArrays:
    """Read a scene of any SH degree; coefficients beyond degree 3 are ignored.

    The properties may have any order and any type. Other properties are named in a warning. NaN and
    infinity are read as they are. Two scales are a flat Gaussian. The 3D filter of Mip-Splatting
    becomes part of scales and opacities (equation 9 of Yu et al. 2024).

    ``data``: see `open_table`.

    Raises: UserError: the file is missing, damaged, truncated, or a PLY file without Gaussians.
    """
    table = open_table(path, data=data)
    if missing := _missing(table):
        shown = ", ".join(missing[:4]) + (", …" if len(missing) > 4 else "")
        raise Unsupported(
            "a PLY file without 3D Gaussians; missing properties: {shown}",
            shown=shown,
        )
    stored = _rest_count(table)
    k = min(stored, SH_REST_COUNTS[-1])
    if k < stored:
        degree = math.isqrt(stored + 1) - 1
        logger.warning("%s: SH degree %d is reduced to 3", path, degree)

    known = {*_MEANS, *_NORMALS, *_DC, *_RGB, "alpha", "opacity", *_SCALES, *_QUATS, _FILTER}
    if others := sorted(table.columns.keys() - known - {*_rest_names(stored)}):
        logger.warning("%s: not read, and lost: %s", path, first_names(others, 8))
    if _Z_UP in map(str.lower, table.comments):
        logger.warning(
            "%s: its z axis is up; to turn it upright, convert with --rotate 90 0 0", path
        )

    n = table.count
    exact = any(table.columns[name] == "f8" for name in _MEANS) or table.format == "ascii"
    means = np.empty((n, 3), np.float64 if exact else np.float32)
    log_scales = np.empty((n, 3), np.float32)
    quats = np.empty((n, 4), np.float32)
    opacity_logits = np.empty(n, np.float32)
    sh_dc = np.empty((n, 1, 3), np.float32)
    sh_rest = np.empty((n, k, 3), np.float32)
    filters = np.empty(n, np.float32)
    colored = any(name not in table.columns for name in _DC)
    scales = [name for name in _SCALES if name in table.columns]
    columns: list[tuple[str, np.ndarray]] = [
        *zip(_MEANS, means.T, strict=True),
        *zip(_RGB if colored else _DC, sh_dc[:, 0].T, strict=True),
        ("opacity", opacity_logits),
        *zip(scales, log_scales.T, strict=False),
        *zip(_QUATS, quats.T, strict=True),
        *((f"f_rest_{c * stored + i}", sh_rest[:, i, c]) for c in range(3) for i in range(k)),
        *([(_FILTER, filters)] if _FILTER in table.columns else []),
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinity
        for start, rows in table.rows():
            for name, target in columns:
                target[start : start + len(rows)] = rows[name]
        if len(scales) < 3:
            log_scales[:, 2] = log_scales[:, :2].min(1) + FLAT
            logger.info("%s: two scales per Gaussian (2DGS); read as flat Gaussians", path)
        if colored:
            sh_dc = (sh_dc / _white(table, sh_dc) - 0.5) / SH_C0
            logger.info("%s: colours (red, green, blue) without f_dc", path)
        if _FILTER in table.columns:
            log_scales, opacity_logits = _filtered(log_scales, opacity_logits, filters)
            logger.info("%s: its filter_3D (Mip-Splatting) is applied to scales, opacities", path)
        arrays = (means, log_scales, quats, opacity_logits, sh_dc, sh_rest)
        scene = float32_gaussians(*arrays, antialiased=is_antialiased(table.comments))
    if problem := unusable(scene):
        logger.warning("%s: %s; they are not shown", path, problem)
    origin, metres = placement_in(table.comments)
    return replace(scene, origin=add_origins(scene.origin, origin), metres_per_unit=metres)


def _rest_count(table: PlyTable) -> int:
    """K of the f_rest properties of a file; may be that of a degree above 3.

    Raises: UserError: their number or their names do not match an SH degree.
    """
    rest = [name for name in table.columns if name.startswith("f_rest_")]
    counts = [(degree + 1) ** 2 - 1 for degree in range(_HIGHEST_DEGREE + 1)]
    if (
        len(rest) % 3
        or len(rest) // 3 not in counts
        or set(rest) != set(_rest_names(len(rest) // 3))
    ):
        raise Unsupported(
            "{rest} f_rest properties do not match an SH degree; expected 0, 9, 24, 45 "
            "or 72, numbered from 0",
            rest=len(rest),
        )
    return len(rest) // 3


def _white(table: PlyTable, colors: np.ndarray) -> float:
    """The value of white: 1 or 255 for floating-point colours, else the largest integer."""
    code = table.columns[_RGB[0]]
    if code[0] == "f":
        return 255.0 if np.nanmax(colors, initial=0) > 1.5 else 1.0
    return 65535.0 if code == "u2" else 255.0


def _filtered(
    log_scales: np.ndarray, logits: np.ndarray, filters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log scales and logits with the 3D filter f: s' = √(s² + f²), o' = o · √(det S² / det S'²)."""
    logs = log_scales.astype(np.float64)
    with np.errstate(divide="ignore"):
        wider = np.logaddexp(2 * logs, 2 * np.log(np.abs(filters.astype(np.float64)))[:, None]) / 2
    fainter = np.where(wider == logs, 0, logs - wider).sum(1)  # log of the factor of the opacity
    # logit(c σ(x)) = log c − log(1 − c + exp(−x))
    with np.errstate(divide="ignore", over="ignore"):
        result = fainter - np.log(-np.expm1(fainter) + np.exp(-logits.astype(np.float64)))
    unchanged = fainter == 0
    return wider, np.where(unchanged, logits, result)


def placement_in(comments: Sequence[str]) -> tuple[Origin, float | None]:
    """The origin and the metres per unit that the last such comments have; `HERE` and None without
    them."""
    origin, metres = HERE, None
    for line in comments:
        try:
            values = [float(word) for word in line.split()[1:]]
        except ValueError:
            continue
        if line.startswith(_ORIGIN):
            origin = stored_origin(values) or origin
        elif line.startswith(_METRES) and len(values) == 1:
            metres = stored_metres(values[0]) or metres
    return origin, metres


def is_antialiased(comments: Sequence[str]) -> bool:
    """Whether the last comment that names a mode of rendering names the antialiased one."""
    marks = [_MODES[line] for line in map(str.lower, comments) if line in _MODES]
    return bool(marks) and marks[-1]


def scene_comments(antialiased: bool, origin: Origin, metres: float | None) -> list[str]:
    """The comments of a header for `is_antialiased` and `placement_in`; most scenes need none."""
    comments = ["SplatRenderMode: mip"] if antialiased else []
    comments += [_ORIGIN + " ".join(map(repr, origin))] if any(origin) else []
    return comments + ([f"{_METRES}{metres!r}"] if metres else [])


def write_ply(path: Path | str, gaussians: GaussianArrays, *, georeferenced: bool = False) -> None:
    """Write the layout above, binary little-endian, atomically.

    ``georeferenced``: write the positions in the world, as doubles if the scene has an origin.

    Raises: OSError: the folder is missing or not writable, or the disk is full.
    """
    write_ply_parts(
        path,
        len(gaussians.means),
        gaussians.sh_rest.shape[1],
        [gaussians],
        antialiased=gaussians.antialiased,
        origin=gaussians.origin,
        metres_per_unit=gaussians.metres_per_unit,
        georeferenced=georeferenced,
    )


def write_ply_parts(
    path: Path | str,
    count: int,
    rest: int,
    parts: Iterable[GaussianArrays],
    *,
    antialiased: bool,
    origin: Origin = HERE,
    metres_per_unit: float | None = None,
    georeferenced: bool = False,
) -> None:
    """`write_ply` for a scene that does not fit into the memory: its parts one after the other.

    Args:
        count: number of Gaussians of all parts.
        rest: K, the number of SH coefficients beyond the constant one; parts may have fewer.
        antialiased: whether the scene is marked as `Gaussians.antialiased`.
        origin, metres_per_unit: those of all parts.
        georeferenced: see `write_ply`.

    Raises: OSError: see `write_ply`.
    """
    names = [*_MEANS, *_NORMALS, *_DC, *_rest_names(rest), "opacity", *_SCALES, *_QUATS]
    exact = georeferenced and any(origin)
    kinds = [("double" if exact and name in _MEANS else "float", name) for name in names]
    row = np.dtype([("means", "<f8" if exact else "<f4", 3), ("others", "<f4", len(names) - 3)])
    written = 0
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        comments = scene_comments(antialiased, HERE if exact else origin, metres_per_unit)
        file.write(header_of([("vertex", count, kinds)], comments))
        for part in parts:
            for start in range(0, len(part.means), _WRITE_ROWS):
                chunk = part.select(slice(start, start + _WRITE_ROWS))
                rows = np.empty(len(chunk.means), row)
                rows["means"] = chunk.world_means() if exact else chunk.means
                rows["others"] = _others(chunk, rest)
                file.write(rows.tobytes())
            written += len(part.means)
        assert written == count


def _others(gaussians: GaussianArrays, rest: int) -> np.ndarray:
    """(N, columns) the rows after x y z; SH coefficients that are missing are zeros."""
    _, log_scales, quats, opacity_logits, sh_dc, sh_rest = gaussians
    n, k = sh_rest.shape[:2]
    by_channel = np.zeros((n, 3, rest), np.float32)
    by_channel[..., :k] = sh_rest.transpose(0, 2, 1)
    columns = (np.zeros((n, 3), np.float32), sh_dc[:, 0], by_channel.reshape(n, 3 * rest))
    return np.concatenate([*columns, opacity_logits[:, None], log_scales, quats], 1)
