"""Compressed PLY files, as SuperSplat writes them: 16 bytes a Gaussian, and one for each SH value.

Three elements: ``chunk``, ``vertex``, and ``sh`` where there is view-dependent colour. A chunk is
256 Gaussians (the last one fewer) that lie close together; it holds the least and greatest
position, log scale and colour of them as floats. A vertex is four words, whose bits from the
highest on are

===============  ============  ==================================================================
packed_position  11, 10, 11    x, y, z between the bounds of the chunk
packed_rotation  2, 10·3       which of w, x, y, z is largest; the others from −1/√2 to 1/√2
packed_scale     11, 10, 11    log scales between the bounds of the chunk
packed_color     8, 8, 8, 8    r, g, b between the bounds of the chunk (0 to 1 where the chunk has
                               none), opacity
===============  ============  ==================================================================

``sh`` has f_rest_0, … as in an uncompressed PLY, a byte each, from −4 to 4. The frame is that of
the uncompressed PLY. Facts from github.com/playcanvas/splat-transform (MIT).
"""

from pathlib import Path

import numpy as np
import torch

from snowsplat.formats import packing
from snowsplat.scene.gaussians import SH_C0, SH_REST_COUNTS, Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.ply import PlyTable, header_of, open_table

_CHUNK = 256
_AXES = ("x", "y", "z")
_GEOMETRY_BOUNDS = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max")
                    for axis in _AXES]  # fmt: skip
_COLOR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_LOG_SCALE_LIMIT = 20.0
_SH_LIMIT = 4.0
#: Shift and bits of each part of a word.
_XYZ = ((21, 11), (11, 10), (0, 11))
_QUAT = ((20, 10), (10, 10), (0, 10))
_RGBA = ((24, 8), (16, 8), (8, 8), (0, 8))


def is_compressed_ply(head: bytes) -> bool:
    """Whether a file that begins so is a compressed PLY file."""
    return head.startswith(b"ply") and b"\nelement chunk " in head and b"packed_position" in head


@np.errstate(all="ignore")  # what is not finite is left out at the end
def read_compressed_ply(path: Path | str) -> Gaussians:
    """Read a scene of any SH degree.

    Raises:
        UserError: not readable, damaged, too short, or a PLY file of something else.
    """
    path = Path(path)
    vertices, chunks = open_table(path), open_table(path, "chunk")
    missing = [n for n in _WORDS if vertices.columns.get(n) != "u4"]
    missing += [n for n in _GEOMETRY_BOUNDS if n not in chunks.columns]
    if missing:
        raise UserError(f"{path}: not a compressed PLY file that I know: it has no {missing[0]}")
    n = vertices.count
    if chunks.count * _CHUNK < n:
        raise UserError(
            f"{path}: the compressed PLY file has {chunks.count} chunks for {n} Gaussians; "
            "it is damaged, export it again"
        )
    bounds = _columns(chunks, _GEOMETRY_BOUNDS)
    colors = np.zeros((chunks.count, 6), np.float32)
    colors[:, 3:] = 1
    if all(name in chunks.columns for name in _COLOR_BOUNDS):
        colors = _columns(chunks, _COLOR_BOUNDS)
    words = _columns(vertices, _WORDS, np.uint32)
    rgba = _parts(words[:, 3], _RGBA)
    largest = (words[:, 1] >> np.uint32(30)).astype(np.int64)
    others = (_parts(words[:, 1], _QUAT) / np.float32(1023) - np.float32(0.5)) * np.sqrt(
        np.float32(2)
    )
    return packing.to_gaussians(
        path,
        _between(bounds[:, :3], bounds[:, 3:6], _parts(words[:, 0], _XYZ), _steps(_XYZ)),
        _between(bounds[:, 6:9], bounds[:, 9:], _parts(words[:, 2], _XYZ), _steps(_XYZ)),
        packing.from_largest_of_four(largest, others),
        packing.opacity_logits(rgba[:, 3]),
        (_between(colors[:, :3], colors[:, 3:], rgba[:, :3], 255)[:, None] - 0.5) / SH_C0,
        _read_sh(path, vertices),
    )


def _read_sh(path: Path, vertices: PlyTable) -> np.ndarray:
    """sh_rest (N, K, 3); K = 0 where the file has no ``sh`` element."""
    n = vertices.count
    if "sh" not in vertices.elements:
        return np.zeros((n, 0, 3), np.float32)
    table = open_table(path, "sh")
    k = len(table.columns) // 3
    names = [f"f_rest_{i}" for i in range(3 * k)]
    if k not in SH_REST_COUNTS or list(table.columns) != names or table.count != n:
        raise UserError(
            f"{path}: the compressed PLY file's 'sh' element has {len(table.columns)} properties "
            f"of {table.count} Gaussians; 9, 24 or 45 of {n} are possible"
        )
    steps = np.arange(256) + 0.5
    steps[[0, 255]] = 0, 256
    values = ((steps / 128 - 1) * _SH_LIMIT).astype(np.float32)
    return values[_columns(table, names, np.uint8)].reshape(n, 3, k).transpose(0, 2, 1)


def _columns(table: PlyTable, names: list[str], dtype: type = np.float32) -> np.ndarray:
    found: np.ndarray = np.empty((table.count, len(names)), dtype)
    for start, rows in table.rows():
        for i, name in enumerate(names):
            found[start : start + len(rows), i] = rows[name]
    return found


def _parts(words: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(N, P) integers that lie at these shifts and of so many bits in words (N,)."""
    shifts, masks = np.array([(s, (1 << bits) - 1) for s, bits in places], np.uint32).T
    return words[:, None] >> shifts & masks


def _steps(places: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.array([(1 << bits) - 1 for _, bits in places], np.float32)


def _between(
    low: np.ndarray, high: np.ndarray, parts: np.ndarray, steps: np.ndarray | int
) -> np.ndarray:
    """(N, 3): ``parts`` of so many ``steps`` on the way from ``low`` to ``high`` (chunks, 3)."""
    chunk = np.arange(len(parts)) // _CHUNK
    t = parts / np.float32(steps)
    return low[chunk] * (1 - t) + high[chunk] * t


@np.errstate(all="ignore")  # what is too large is clamped
def write_compressed_ply(path: Path | str, gaussians: Gaussians) -> None:
    """Write the layout above, in the order of a space-filling curve, atomically.

    Raises:
        OSError: the folder is absent or not writable, or the disk is full.
    """
    parts = _contents(Path(path), gaussians)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(parts)


def compressed_ply(path: Path, gaussians: Gaussians) -> bytes:
    """What `write_compressed_ply` writes into ``path``, which is not touched here."""
    return b"".join(_contents(path, gaussians))


def _contents(path: Path, gaussians: Gaussians) -> list[bytes]:
    arrays = packing.to_arrays(path, gaussians)
    order = morton_order(torch.from_numpy(arrays[0])).numpy()
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = (array[order] for array in arrays)
    n, k = sh_rest.shape[:2]
    log_scales = np.clip(log_scales, -_LOG_SCALE_LIMIT, _LOG_SCALE_LIMIT)
    colors = 0.5 + SH_C0 * sh_dc[:, 0]

    bounds = [_bounds(values) for values in (means, log_scales, colors)]
    words = np.empty((n, 4), "<u4")
    words[:, 0] = _packed(_parts_of(means, bounds[0], _steps(_XYZ)), _XYZ)
    largest, others = packing.largest_of_four(quats)
    tens = np.rint((others * np.sqrt(0.5) + 0.5) * 1023)
    words[:, 1] = _packed(tens, _QUAT) | largest.astype(np.uint32) << np.uint32(30)
    words[:, 2] = _packed(_parts_of(log_scales, bounds[1], _steps(_XYZ)), _XYZ)
    alpha = packing.opacity_bytes(opacity_logits)[:, None]
    words[:, 3] = _packed(
        np.concatenate([_parts_of(colors, bounds[2], np.float32(255)), alpha], 1), _RGBA
    )
    rest = sh_rest.transpose(0, 2, 1).reshape(n, 3 * k)
    sh = np.clip(np.floor((rest / _SH_LIMIT + 1) * 128), 0, 255).astype(np.uint8)

    elements = [
        ("chunk", len(bounds[0]), [("float", name) for name in _GEOMETRY_BOUNDS + _COLOR_BOUNDS]),
        ("vertex", n, [("uint", name) for name in _WORDS]),
    ]
    if k:
        elements.append(("sh", n, [("uchar", f"f_rest_{i}") for i in range(3 * k)]))
    limits = np.concatenate(bounds, 1).astype("<f4")
    return [header_of(elements), limits.tobytes(), words.tobytes(), sh.tobytes()]


def _bounds(values: np.ndarray) -> np.ndarray:
    """(chunks, 6): the least and the greatest of each chunk's values (N, 3)."""
    starts = np.arange(0, len(values), _CHUNK)
    if not len(starts):
        return np.zeros((0, 6), np.float32)
    ends = [function.reduceat(values, starts) for function in (np.minimum, np.maximum)]
    return np.concatenate(ends, 1)


def _parts_of(values: np.ndarray, bounds: np.ndarray, steps: np.ndarray | np.float32) -> np.ndarray:
    """How many of so many ``steps`` each of the values (N, 3) is from its chunk's least one."""
    chunk = np.arange(len(values)) // _CHUNK
    low, high = bounds[:, :3].astype(np.float64), bounds[:, 3:].astype(np.float64)
    width = np.where(high > low, high - low, 1)
    return np.rint((values - low[chunk]) / width[chunk] * steps)


def _packed(parts: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(N,) words of whole numbers (N, P), each at its shift; the inverse of `_parts`."""
    words = np.zeros(len(parts), np.uint32)
    for i, (shift, bits) in enumerate(places):
        words |= np.clip(parts[:, i], 0, (1 << bits) - 1).astype(np.uint32) << np.uint32(shift)
    return words
