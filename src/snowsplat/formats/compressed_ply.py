"""Compressed PLY files, the format of SuperSplat: 16 bytes per Gaussian and one per SH value.

There are three elements: ``chunk``, ``vertex``, and ``sh`` if the colour depends on the view. A
chunk is 256 Gaussians (the last one may be smaller) that lie close together; it stores the minimum
and maximum of their positions, log scales and colours as floats. A vertex is four words, with these
bits from the highest to the lowest:

===============  ============  ==================================================================
packed_position  11, 10, 11    x, y, z between the bounds of the chunk
packed_rotation  2, 10·3       index of the largest of w, x, y, z; the others, −1/√2 to 1/√2
packed_scale     11, 10, 11    log scales between the bounds of the chunk
packed_color     8, 8, 8, 8    r, g, b between the bounds of the chunk (0 to 1 if the chunk has
                               none), opacity
===============  ============  ==================================================================

The element ``sh`` has the properties f_rest_0, … of an uncompressed PLY. Each is one byte, which
represents the range −4 to 4. The coordinate frame, and the comment of an antialiased scene, are
those of the uncompressed PLY. The layout was taken from
github.com/playcanvas/splat-transform (MIT).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.damage import Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.ply import is_antialiased, placement_in, scene_comments
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS
from snowsplat.util.files import write_bytes
from snowsplat.util.messages import message
from snowsplat.util.ply import PlyTable, header_of, open_table

_CHUNK = 256
_AXES = ("x", "y", "z")
_GEOMETRY_BOUNDS = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max")
                    for axis in _AXES]  # fmt: skip
_COLOR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_LOG_SCALE_LIMIT = 20.0
_SH_LIMIT = 4.0
#: Shift and number of bits of each field of a word.
_XYZ = ((21, 11), (11, 10), (0, 11))
_QUAT = ((20, 10), (10, 10), (0, 10))
_RGBA = ((24, 8), (16, 8), (8, 8), (0, 8))


def is_compressed_ply(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a compressed PLY file."""
    return head.startswith(b"ply") and b"\nelement chunk " in head and b"packed_position" in head


@reads
def read_compressed_ply(path: Path, data: bytes | None = None) -> GaussianArrays:
    """Read a scene of any SH degree.

    ``data``: see `open_table`.

    Raises:
        UserError: the file cannot be read, is damaged or truncated, or is another kind of PLY file.
    """
    vertices, chunks = open_table(path, data=data), open_table(path, "chunk", data)
    missing = [n for n in _WORDS if vertices.columns.get(n) != "u4"]
    missing += [n for n in _GEOMETRY_BOUNDS if n not in chunks.columns]
    if missing:
        raise Unsupported(
            "not a supported compressed PLY file; it has no {missing}",
            missing=missing[0],
        )
    n = vertices.count
    if chunks.count * _CHUNK < n:
        raise Unsupported(
            "the compressed PLY file has only {count} chunks for {number} Gaussians; it "
            "is damaged, export it again",
            count=chunks.count,
            number=n,
        )
    bounds = _columns(chunks, _GEOMETRY_BOUNDS)
    colors = np.zeros((chunks.count, 6), np.float32)
    colors[:, 3:] = 1
    if all(name in chunks.columns for name in _COLOR_BOUNDS):
        colors = _columns(chunks, _COLOR_BOUNDS)
    words = _columns(vertices, _WORDS, np.uint32)
    rgba = _fields(words[:, 3], _RGBA)
    largest = (words[:, 1] >> np.uint32(30)).astype(np.int64)
    others = (_fields(words[:, 1], _QUAT) / np.float32(1023) - np.float32(0.5)) * np.sqrt(
        np.float32(2)
    )
    steps = _largest_integers(_XYZ)
    scene = usable_gaussians(
        path,
        _dequantize(bounds[:, :3], bounds[:, 3:6], _fields(words[:, 0], _XYZ), steps).astype("f4"),
        _dequantize(bounds[:, 6:9], bounds[:, 9:], _fields(words[:, 2], _XYZ), steps),
        packing.from_largest_of_four(largest, others),
        packing.opacity_logits(rgba[:, 3]),
        (_dequantize(colors[:, :3], colors[:, 3:], rgba[:, :3], 255)[:, None] - 0.5) / SH_C0,
        _read_sh(path, vertices, data),
        antialiased=is_antialiased(vertices.comments),
    )
    origin, metres = placement_in(vertices.comments)
    return replace(scene, origin=origin, metres_per_unit=metres)


def _read_sh(path: Path, vertices: PlyTable, data: bytes | None) -> np.ndarray:
    """sh_rest (N, K, 3); K = 0 if the file has no ``sh`` element."""
    n = vertices.count
    if "sh" not in vertices.elements:
        return np.zeros((n, 0, 3), np.float32)
    table = open_table(path, "sh", data)
    k = len(table.columns) // 3
    names = [f"f_rest_{i}" for i in range(3 * k)]
    if k not in SH_REST_COUNTS or list(table.columns) != names or table.count != n:
        raise Unsupported(
            "the 'sh' element of the compressed PLY file has {columns} properties of "
            "{count} Gaussians; expected 9, 24 or 45 of {number}",
            columns=len(table.columns),
            count=table.count,
            number=n,
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


def _fields(words: np.ndarray, layout: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(N, P) integers: the fields of words (N,), each a pair (shift, bits) of ``layout``."""
    shifts, masks = np.array([(s, (1 << bits) - 1) for s, bits in layout], np.uint32).T
    return words[:, None] >> shifts & masks


def _largest_integers(layout: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(P,) the largest integer that each field can store."""
    return np.array([(1 << bits) - 1 for _, bits in layout], np.float32)


def _dequantize(
    low: np.ndarray, high: np.ndarray, fields: np.ndarray, steps: np.ndarray | int
) -> np.ndarray:
    """(N, 3) values of ``fields`` (N, 3), 0 … ``steps``, between the bounds of their chunk. ``low``
    and ``high`` are (chunks, 3)."""
    chunk = np.arange(len(fields)) // _CHUNK
    t = fields / np.float32(steps)
    return low[chunk] * (1 - t) + high[chunk] * t


@np.errstate(all="ignore")  # values that are too large are clamped
def write_compressed_ply(path: Path | str, gaussians: GaussianArrays) -> None:
    """Write the layout above, in the order of a space-filling curve, atomically.

    Raises: OSError: the folder is missing or not writable, or the disk is full.
    """
    write_bytes(path, _encode(Path(path), gaussians))


def encode_compressed_ply(path: Path, gaussians: GaussianArrays) -> bytes:
    """The content of a compressed PLY file; ``path`` is used in warnings only."""
    return b"".join(_encode(path, gaussians))


def _encode(path: Path, gaussians: GaussianArrays) -> list[bytes]:
    packable = packing.packable(path, gaussians)
    order = packing.spatial_order(packable.means)
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = packable.select(order)
    n, k = sh_rest.shape[:2]
    cut = packing.Cut(path, "compressed PLY", n)
    packing.cut_scales(cut, log_scales, -_LOG_SCALE_LIMIT, _LOG_SCALE_LIMIT, step=0)
    beyond = (np.abs(sh_rest) > _SH_LIMIT).any((1, 2))
    cut.note(message("SH"), beyond, message("at most 4"), rare=True)
    log_scales = np.clip(log_scales, -_LOG_SCALE_LIMIT, _LOG_SCALE_LIMIT)
    colors = 0.5 + SH_C0 * sh_dc[:, 0]

    bounds = [_bounds(values) for values in (means, log_scales, colors)]
    words = np.empty((n, 4), "<u4")
    words[:, 0] = _pack(_quantize(means, bounds[0], _largest_integers(_XYZ)), _XYZ)
    largest, others = packing.largest_of_four(quats)
    ten_bits = np.rint((others * np.sqrt(0.5) + 0.5) * 1023)
    words[:, 1] = _pack(ten_bits, _QUAT) | largest.astype(np.uint32) << np.uint32(30)
    words[:, 2] = _pack(_quantize(log_scales, bounds[1], _largest_integers(_XYZ)), _XYZ)
    alpha = packing.opacity_bytes(opacity_logits)[:, None]
    words[:, 3] = _pack(
        np.concatenate([_quantize(colors, bounds[2], np.float32(255)), alpha], 1), _RGBA
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
    comments = scene_comments(gaussians.antialiased, gaussians.origin, gaussians.metres_per_unit)
    head = header_of(elements, comments)
    cut.report(".ply keeps them")
    return [head, limits.tobytes(), words.tobytes(), sh.tobytes()]


def _bounds(values: np.ndarray) -> np.ndarray:
    """(chunks, 6): the minimum and the maximum of the values (N, 3) of each chunk."""
    starts = np.arange(0, len(values), _CHUNK)
    if not len(starts):
        return np.zeros((0, 6), np.float32)
    ends = [function.reduceat(values, starts) for function in (np.minimum, np.maximum)]
    return np.concatenate(ends, 1)


def _quantize(values: np.ndarray, bounds: np.ndarray, steps: np.ndarray | np.float32) -> np.ndarray:
    """(N, 3) whole numbers, 0 … ``steps``, of values (N, 3) between the bounds of their chunk."""
    chunk = np.arange(len(values)) // _CHUNK
    low, high = bounds[:, :3].astype(np.float64), bounds[:, 3:].astype(np.float64)
    width = np.where(high > low, high - low, 1)
    return np.rint((values - low[chunk]) / width[chunk] * steps)


def _pack(fields: np.ndarray, layout: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(N,) words with the whole numbers (N, P) as fields; the inverse of `_fields`."""
    words = np.zeros(len(fields), np.uint32)
    for i, (shift, bits) in enumerate(layout):
        words |= np.clip(fields[:, i], 0, (1 << bits) - 1).astype(np.uint32) << np.uint32(shift)
    return words
