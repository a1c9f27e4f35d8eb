"""`.spz` files of Niantic: about 20 bytes per Gaussian and one per SH value, then compressed.

The file has a header and then these columns, each of which contains all Gaussians:

=========  =======  ======================================================================
position   9 bytes  3 signed 24-bit fixed-point numbers with ``fractional_bits``;
                    version 1: 3 halves
opacity    1        255 · opacity
colour     3        127.5 + 38.25 · sh_dc, which also represents colours outside of 0 to 1
scales     3        16 · (log scale + 10)
rotation   4        2 bits: index of the largest of x, y, z, w; the others 10 bits each: a sign
                    and nine bits of 511 · √2 · |q|;
                    versions 1 and 2: 3 bytes, 127.5 · (q + 1) of x, y, z
SH         0 to 72  128 + 128 · sh_rest, coefficient by coefficient, r, g, b in each
=========  =======  ======================================================================

Values are little-endian, in a frame with x right, y up, z back. `spz_container` handles the header
and the compression. The layout was taken from github.com/nianticlabs/spz (MIT).
"""

import logging
import math
import struct
from pathlib import Path

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.damage import Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, usable_gaussians
from snowsplat.formats.spz_container import (
    ANTIALIASED,
    Header,
    is_of_spark,
    is_spz,
    pack,
    read_header,
    unpack,
)
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.util.files import write_bytes
from snowsplat.util.messages import message

__all__ = ["WRITTEN_VERSIONS", "is_spz", "parse_spz", "read_spz", "spz_version", "write_spz"]

logger = logging.getLogger(__name__)

#: The versions that `write_spz` can write.
WRITTEN_VERSIONS = (2, 3, 4)

#: The type of an extension that selects the frame by a number. 0 is the default frame, n is the
#: n-th frame of `_FRAMES`. Larger numbers have the y and z axes swapped and are not supported.
_FRAME_EXTENSION = 0xADBE0003
_FRAMES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
# The signs of a quaternion wxyz times 1, i, j and k. The entries of the n-th product are in the
# order 0 ^ n, 1 ^ n, 2 ^ n, 3 ^ n.
_HALF_TURNS = np.array(
    [[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]], dtype=np.float32
)
_COLOR_STEP = 0.15 * 255
_COLOR_LIMIT = 127.5 / _COLOR_STEP
_SCALE_RANGE = (-10.0, 255 / 16 - 10)  # logarithms
# SH bytes are rounded to multiples of these (degree 1, higher degrees), so that they compress
# better. Niantic's implementation uses 8 and 16, which lower the PSNR of a trained scene by more
# than 1 dB. 2 and 4 lower it by 0.1 dB, and the file is 1.5 times as large.
_SH_STEPS = (2, 4)


@reads
def read_spz(path: Path) -> GaussianArrays:
    """Read a scene of version 1 to 4. Coefficients of SH degree 4 are ignored.

    Raises: UserError: the file cannot be read, has another version, is damaged or truncated, or
    declares an implausible number of Gaussians.
    """
    return parse_spz(path, path.read_bytes())


@reads
def parse_spz(path: Path, data: bytes) -> GaussianArrays:
    """The scene in the content ``data`` of a file, as `read_spz`; ``path`` is for messages."""
    contents = unpack(data)
    header, columns = contents.header, contents.columns
    if header.sh_degree > 3:
        logger.warning("%s: SH degree %d is reduced to 3", path, header.sh_degree)
    n = header.count
    rows = [
        np.frombuffer(column, np.uint8).reshape(n, -1 if n else width)
        for column, width in zip(columns, header.columns(), strict=True)
    ]
    if header.flags & ANTIALIASED and is_of_spark(data):
        logger.warning(
            "%s: seems to be of Spark, which marks all scenes as antialiased (if it was not "
            "trained so, render it with --antialias off) and does not convert axes (if it is "
            "upside down, convert it with --rotate 180 0 0)",
            path,
        )
    position, alpha, color, scales, rotation, sh = rows
    sh_rest = sh.reshape(len(sh), sh.shape[1] // 3, 3)[:, : SH_REST_COUNTS[-1]]
    stored = GaussianArrays(
        _unpack_positions(position, header),
        scales.astype(np.float32) / 16 - 10,
        _unpack_rotations(rotation),
        packing.opacity_logits(alpha[:, 0]),
        (color.astype(np.float32)[:, None] - 127.5) / _COLOR_STEP,
        (sh_rest.astype(np.float32) - 128) / 128,
    )
    scene = packing.flip_axes(stored, _signs(contents.extensions))
    return usable_gaussians(path, *scene, antialiased=bool(header.flags & ANTIALIASED))


@reads
def spz_version(path: Path) -> str:
    """The version of a file that `read_spz` accepts."""
    return str(read_header(path.read_bytes()).version)


def _signs(extensions: bytes) -> tuple[int, int, int]:
    """1 or −1 for each axis: the factors that convert the frame of the file to that of PLY."""
    start = 0
    while start + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        if kind == _FRAME_EXTENSION and size == 4 and start + 12 <= len(extensions):
            (number,) = struct.unpack_from("<I", extensions, start + 8)
            if number > len(_FRAMES):
                raise Unsupported(
                    "SPZ coordinate system {number} (swapped y and z axes) is not "
                    "supported; export the file with the default coordinate system RUB",
                    number=number,
                )
            axes = _FRAMES[number - 1] if number else "RUB"
            return 1 if "R" in axes else -1, 1 if "D" in axes else -1, 1 if "F" in axes else -1
        start += 8 + size
    return packing.UP_BACK


def _unpack_positions(position: np.ndarray, header: Header) -> np.ndarray:
    if header.version == 1:
        return position.view("<f2").astype(np.float32)
    # Three bytes become the upper bytes of an int32; the arithmetic shift then extends the sign.
    words = np.zeros((len(position), 3, 4), np.uint8)
    words[:, :, 1:] = position.reshape(-1, 3, 3)
    fixed = words.view("<i4")[:, :, 0] >> 8
    return (fixed / (1 << header.fractional_bits)).astype(np.float32)


def _unpack_rotations(rotation: np.ndarray) -> np.ndarray:
    """Quaternions wxyz (N, 4); the file stores xyzw."""
    if rotation.shape[1] == 3:
        xyz = rotation.astype(np.float32) / 127.5 - 1
        w = np.sqrt(np.maximum(1 - (xyz * xyz).sum(1, keepdims=True), 0))
        return packing.unit_quats(np.concatenate([w, xyz], 1))
    words = np.ascontiguousarray(rotation).view("<u4")
    parts = words >> np.array([20, 10, 0], np.uint32) & np.uint32(1023)
    size = (parts & 511).astype(np.float32) * np.float32(np.sqrt(0.5) / 511)
    others = np.where(parts >> np.uint32(9), -size, size)
    xyzw = packing.from_largest_of_four((words[:, 0] >> np.uint32(30)).astype(np.int64), others)
    return np.roll(xyzw, 1, axis=1)


@np.errstate(all="ignore")  # values that are too large are clamped
def write_spz(path: Path | str, gaussians: GaussianArrays, version: int = 3) -> None:
    """Write a scene, atomically.

    Args:
        version: 3; 2 for readers that are older, with rotations of 3 bytes; or 4, which is smaller
            and faster to read and write, but which older readers do not know.

    Raises:
        ValueError: ``version`` is not in `WRITTEN_VERSIONS`.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    if version not in WRITTEN_VERSIONS:
        raise ValueError(f"version {version} of .spz cannot be written; use 2, 3 or 4")
    path = Path(path)
    scene = packing.flip_axes(packing.packable(path, gaussians))
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = scene
    bits = _fractional_bits(means)
    cut = packing.Cut(path, "SPZ", len(means))
    columns = [
        _pack_positions(cut, means, bits),
        packing.opacity_bytes(opacity_logits),
        packing.to_bytes(127.5 + _COLOR_STEP * sh_dc),
        packing.to_bytes(16 * (log_scales + 10)),
        _pack_rotations(quats) if version > 2 else _pack_rotations_in_3_bytes(quats),
        _pack_sh(sh_rest),
    ]
    degree = SH_REST_COUNTS.index(sh_rest.shape[1])
    flags = ANTIALIASED if gaussians.antialiased else 0
    header = Header(version, len(means), degree, bits, flags)
    write_bytes(path, pack(header, [column.tobytes() for column in columns]))
    if len(means) and 2.0**-bits > 0.5 * math.exp(min(80.0, float(np.median(log_scales.max(1))))):
        details = message("in steps of {size:.2g}", size=2.0**-bits)
        cut.note(message("positions"), np.ones(len(means), bool), details)
    packing.cut_scales(cut, log_scales, *_SCALE_RANGE, step=1 / 32)
    beyond = (np.abs(sh_dc) > _COLOR_LIMIT + 0.5 / _COLOR_STEP).any((1, 2))
    cut.note(message("colours"), beyond, message("from -0.44 to 1.44"), rare=True)
    beyond = (np.abs(sh_rest) > 1 + _SH_STEPS[1] / 128).any((1, 2))
    cut.note(message("SH"), beyond, message("at most 1"), rare=True)
    cut.report(_advice(log_scales))


def _advice(log_scales: np.ndarray) -> str:
    """What to do if a scene does not fit: another unit of length, or another format."""
    factor = packing.fitting_factor(log_scales, *_SCALE_RANGE) if len(log_scales) else None
    others = ".ply, .glb or .sog keep them"
    return others if factor in (None, 1) else f"scaled by {factor:g}, all scales fit; {others}"


def _fractional_bits(means: np.ndarray) -> int:
    """Usually 12; more for a small scene, fewer for a scene that would not fit in 24 bits.

    Let d be the distance from the origin within which 99% of the Gaussians lie. A quantisation step
    is at most 2⁻¹⁵ d. If a few Gaussians are too far away for that, it is at most 2⁻¹² d, and the
    positions of these Gaussians are clamped if necessary.
    """
    if not len(means):
        return 12
    distance = np.abs(means).max(1).astype(np.float64)
    wanted = int(np.ceil(15 - np.log2(max(float(np.quantile(distance, 0.99)), 1e-30))))
    possible = int(np.floor(23 - np.log2(max(float(distance.max()), 1e-30) * (1 + 2**-22))))
    return max(min(max(12, wanted), max(possible, wanted - 3), 24), 0)


def _pack_positions(cut: packing.Cut, means: np.ndarray, bits: int) -> np.ndarray:
    limit = (1 << 23) - 1
    steps = np.rint(means.astype(np.float64) * (1 << bits))
    details = message("at most {limit:.6g}", limit=limit / (1 << bits))
    cut.note(message("positions"), (np.abs(steps) > limit).any(1), details)
    fixed = np.clip(steps, -limit, limit)
    return fixed.astype("<i4")[:, :, None].view(np.uint8)[:, :, :3]


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    largest, others = packing.largest_of_four(np.roll(quats, -1, axis=1))
    size = np.minimum(np.floor(np.abs(others) * (511 * np.sqrt(2)) + 0.5), 511).astype(np.uint32)
    parts = size | (others < 0).astype(np.uint32) << np.uint32(9)
    words = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        words |= parts[:, i] << np.uint32(shift)
    return words.astype("<u4")


def _pack_rotations_in_3_bytes(quats: np.ndarray) -> np.ndarray:
    """Bytes (N, 3) of x, y, z. Readers compute w from them, which is precise only if w is large.

    A Gaussian that is rotated by 180° about one of its axes remains the same. The product of its
    quaternion and i, j or k is such a rotation, and moves the largest entry to w.
    """
    largest = np.abs(quats).argmax(1)
    turned = np.take_along_axis(quats, np.arange(4) ^ largest[:, None], 1) * _HALF_TURNS[largest]
    return packing.to_bytes(127.5 + 127.5 * np.where(turned[:, :1] < 0, -turned, turned)[:, 1:])


def _pack_sh(sh_rest: np.ndarray) -> np.ndarray:
    """Bytes (N, K, 3), rounded to multiples of `_SH_STEPS`."""
    step = np.where(np.arange(sh_rest.shape[1]) < 3, *_SH_STEPS)[:, None]
    nearest = np.floor((np.rint(sh_rest * 128) + 128 + step // 2) / step) * step
    return np.clip(nearest, 0, 255).astype(np.uint8)
