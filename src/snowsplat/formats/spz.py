"""`.spz` files, of Niantic: about 20 bytes a Gaussian and one for each SH value, then compressed.

A header; then one column after the other for all Gaussians, each row of it

=========  =======  ======================================================================
position   9 bytes  3 signed 24-bit numbers with ``fractional_bits`` after the point;
                    version 1: 3 halves
opacity    1        255 · opacity
colour     3        127.5 + 38.25 · sh_dc, which leaves room outside of 0 to 1
scales     3        16 · (log scale + 10)
rotation   4        2 bits: which of x, y, z, w is largest; the others 10 bits each: a sign and
                    nine bits of 511 · √2 · |q|;
                    versions 1 and 2: 3 bytes, 127.5 · (q + 1) of x, y, z
SH         0 to 72  128 + 128 · sh_rest, coefficient by coefficient, r, g, b in each
=========  =======  ======================================================================

little-endian, in a frame of x right, y up, z back. Versions 1 to 3 have a header of 16 bytes and
are one gzip stream; version 4 has one of 32 bytes, a table, and a zstd stream for each column.
Facts from github.com/nianticlabs/spz (MIT).
"""

import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard

from snowsplat.errors import UserError
from snowsplat.files import atomic_path
from snowsplat.formats import packing
from snowsplat.formats.frames import UP_BACK, flip_axes
from snowsplat.gaussians import SH_REST_COUNTS, Gaussians

logger = logging.getLogger(__name__)

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEAD = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fraction, flags, streams
_HEADER_BYTES = 32  # of version 4
_ANTIALIASED = 1
_EXTENDED = 2
#: An extension that names another frame by a number: these from 1 on, then others with y and z
#: swapped.
_FRAME_EXTENSION = 0xADBE0003
_FRAMES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
_EXTENSION_LIMIT = 1 << 16
# Real scenes are at most twice as large when unpacked, uniform ones a thousand times: a file may
# promise this many bytes, or so many times its size, before it is refused as one made to do harm.
_UNPACKED_LIMIT = 64 << 20
_UNPACKED_RATIO = 64

_COLOR_STEP = 0.15 * 255
_GZIP_LEVEL = 4
_ZSTD_LEVEL = 5


@dataclass
class _Header:
    """What the first 16 bytes say."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int

    def columns(self) -> list[int]:
        """Bytes a Gaussian of position, opacity, colour, scales, rotation, SH."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return [position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1)]


def is_spz(head: bytes) -> bool:
    """Whether a file that begins so is an .spz file of any version."""
    if head.startswith(_GZIP):
        try:
            head = zlib.decompressobj(31).decompress(head, 4)
        except zlib.error:
            return False
    return head.startswith(_MAGIC)


@np.errstate(all="ignore")  # what is not finite is left out at the end
def read_spz(path: Path | str) -> Gaussians:
    """Read a scene of version 1 to 4; of SH degree 4, which is not used here, degrees 0 to 3.

    Raises:
        UserError: not readable, of another version, damaged, too short, or promising absurdly much.
    """
    path = Path(path)
    data = packing.read_file(path)
    try:
        header, columns, extensions = _unpack_file(path, data)
    except (zlib.error, zstandard.ZstdError, struct.error):
        raise _damaged(path) from None
    if header.flags & _ANTIALIASED:
        logger.warning(
            "%s: trained with the anti-aliasing of Mip-Splatting, which is not drawn here; "
            "from afar it looks a little different",
            path,
        )
    if header.sh_degree > 3:
        logger.warning("%s: has SH degree %d; 3 is kept", path, header.sh_degree)
    n = header.count
    position, alpha, color, scales, rotation, sh = (
        np.frombuffer(column, np.uint8).reshape(n, -1 if n else width)
        for column, width in zip(columns, header.columns(), strict=True)
    )
    sh_rest = sh.reshape(n, sh.shape[1] // 3, 3)[:, : SH_REST_COUNTS[-1]]
    means, quats, sh_rest = flip_axes(
        _unpack_positions(position, header),
        _unpack_rotations(rotation),
        (sh_rest.astype(np.float32) - 128) / 128,
        _signs(path, extensions),
    )
    return packing.to_gaussians(
        path,
        means,
        scales.astype(np.float32) / 16 - 10,
        quats,
        packing.opacity_logits(alpha[:, 0]),
        (color.astype(np.float32)[:, None] - 127.5) / _COLOR_STEP,
        sh_rest,
    )


def _unpack_file(path: Path, data: bytes) -> tuple[_Header, list[bytes], bytes]:
    """The header, the columns unpacked, of the right size each, and the extensions' bytes."""
    if not data.startswith(_GZIP):
        header = _header(path, data, len(data))
        if header.version > 3:
            return header, *_unpack_streams(path, data, header)
        body = data[_HEAD.size :]
        size = sum(header.columns()) * header.count
    else:
        stream = zlib.decompressobj(31)
        head = stream.decompress(data, _HEAD.size)
        header = _header(path, head, len(data))
        size = sum(header.columns()) * header.count
        # A whole stream ends; only then its checksum has been compared.
        body = stream.decompress(stream.unconsumed_tail, size + _EXTENSION_LIMIT)
        if header.version > 3 or not stream.eof:
            raise _damaged(path)
    if len(body) < size:
        raise _damaged(path)
    columns, start = [], 0
    for width in header.columns():
        columns.append(body[start : start + width * header.count])
        start += width * header.count
    return header, columns, body[start:] if header.flags & _EXTENDED else b""


def _header(path: Path, head: bytes, file_size: int) -> _Header:
    if not head.startswith(_MAGIC):
        raise UserError(f"{path}: not an .spz file (it should begin with NGSP when unpacked)")
    _, *values = _HEAD.unpack_from(head)
    header = _Header(*values)
    if not 1 <= header.version <= 4:
        raise UserError(f"{path}: version {header.version} of .spz; I read 1 to 4")
    if header.sh_degree > 4 or header.fractional_bits > 31:
        raise _damaged(path)
    size = sum(header.columns()) * header.count
    if size > max(_UNPACKED_LIMIT, _UNPACKED_RATIO * file_size):
        raise UserError(
            f"{path}: an .spz file of {file_size} bytes that promises {header.count} Gaussians; "
            "it is damaged or made to do harm"
        )
    return header


def _unpack_streams(path: Path, data: bytes, header: _Header) -> tuple[list[bytes], bytes]:
    """The columns and the extensions of version 4."""
    (table,) = struct.unpack_from("<I", data, _HEAD.size)
    sizes = [width * header.count for width in header.columns()]
    start = table + 16 * header.streams
    if table < _HEADER_BYTES or header.streams != sum(size > 0 for size in sizes):
        raise _damaged(path)
    entry, columns = table, []
    for size in sizes:
        if not size:
            columns.append(b"")
            continue
        packed, unpacked = struct.unpack_from("<QQ", data, entry)
        if unpacked != size or start + packed > len(data):
            raise _damaged(path)
        # A reader, not decompress(): that believes the size that the stream itself promises.
        unpacker = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        column = unpacker.stream_reader(data[start : start + packed]).read(size + 1)
        if len(column) != size:
            raise _damaged(path)
        columns.append(column)
        entry, start = entry + 16, start + packed
    return columns, data[_HEADER_BYTES:table] if header.flags & _EXTENDED else b""


def _signs(path: Path, extensions: bytes) -> tuple[int, int, int]:
    """What each axis of the file is to be multiplied with to give ours."""
    start = 0
    while start + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        if kind == _FRAME_EXTENSION and size == 4 and start + 12 <= len(extensions):
            (number,) = struct.unpack_from("<I", extensions, start + 8)
            if number > len(_FRAMES):
                raise UserError(
                    f"{path}: an .spz file whose y and z axes are swapped (coordinate system "
                    f"{number}), which I do not read; export it with the usual one, RUB"
                )
            axes = _FRAMES[number - 1] if number else "RUB"
            return 1 if "R" in axes else -1, 1 if "D" in axes else -1, 1 if "F" in axes else -1
        start += 8 + size
    return UP_BACK


def _unpack_positions(position: np.ndarray, header: _Header) -> np.ndarray:
    if header.version == 1:
        return position.view("<f2").astype(np.float32)
    # Into the upper three bytes of an int32, then shifted down: that keeps the sign.
    words = np.zeros((len(position), 3, 4), np.uint8)
    words[:, :, 1:] = position.reshape(-1, 3, 3)
    fixed = words.view("<i4")[:, :, 0] >> 8
    return (fixed / (1 << header.fractional_bits)).astype(np.float32)


def _unpack_rotations(rotation: np.ndarray) -> np.ndarray:
    """Quaternions wxyz; the file has xyzw."""
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


def _damaged(path: Path) -> UserError:
    return UserError(f"{path}: a damaged or incomplete .spz file; copy or export it again")


def write_spz(path: Path | str, gaussians: Gaussians, version: int = 3) -> None:
    """Write version 3, which all readers know, or 4, which is smaller and faster; atomically.

    Raises:
        ValueError: another version.
        OSError: the folder is absent or not writable, or the disk is full.
    """
    if version not in (3, 4):
        raise ValueError(f"version {version} of .spz is not written; 3 or 4")
    path = Path(path)
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = packing.to_arrays(path, gaussians)
    means, quats, sh_rest = flip_axes(means, quats, sh_rest, UP_BACK)
    bits = _fractional_bits(means)
    columns = [
        _pack_positions(means, bits),
        packing.opacity_bytes(opacity_logits),
        packing.to_bytes(127.5 + _COLOR_STEP * sh_dc),
        packing.to_bytes(16 * (log_scales + 10)),
        _pack_rotations(quats),
        _pack_sh(sh_rest),
    ]
    streams = [column.tobytes() for column in columns if column.size]
    count, degree = len(means), SH_REST_COUNTS.index(sh_rest.shape[1])
    head = _HEAD.pack(_MAGIC, version, count, degree, bits, 0, len(streams) if version > 3 else 0)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        if version == 3:
            packer = zlib.compressobj(_GZIP_LEVEL, zlib.DEFLATED, 31)
            for part in (head, *streams):
                file.write(packer.compress(part))
            file.write(packer.flush())
            return
        packed = [zstandard.ZstdCompressor(_ZSTD_LEVEL).compress(stream) for stream in streams]
        file.write(head + struct.pack("<I12x", _HEADER_BYTES))
        for stream, part in zip(streams, packed, strict=True):
            file.write(struct.pack("<QQ", len(part), len(stream)))
        file.write(b"".join(packed))


def _fractional_bits(means: np.ndarray) -> int:
    """12, as is usual; more where the scene is small, fewer where it would not fit in 24 bits.

    A step is then at most 2⁻¹⁵ of how far out 99% of the Gaussians lie.
    """
    if not len(means):
        return 12
    distance = np.abs(means).max(1).astype(np.float64)
    wanted = 15 - np.log2(max(float(np.quantile(distance, 0.99)), 1e-30))
    possible = 23 - np.log2(max(float(distance.max()), 1e-30) * (1 + 2**-22))
    return int(min(max(12, np.ceil(wanted)), max(0, np.floor(possible)), 24))


def _pack_positions(means: np.ndarray, bits: int) -> np.ndarray:
    limit = (1 << 23) - 1
    fixed = np.clip(np.rint(means.astype(np.float64) * (1 << bits)), -limit, limit)
    return fixed.astype("<i4")[:, :, None].view(np.uint8)[:, :, :3]


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    largest, others = packing.largest_of_four(np.roll(quats, -1, axis=1))
    size = np.minimum(np.floor(np.abs(others) * (511 * np.sqrt(2)) + 0.5), 511).astype(np.uint32)
    parts = size | (others < 0).astype(np.uint32) << np.uint32(9)
    words = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        words |= parts[:, i] << np.uint32(shift)
    return words.astype("<u4")


def _pack_sh(sh_rest: np.ndarray) -> np.ndarray:
    """Degree 1 to the nearest multiple of 8, others of 16: the rest of the byte would be noise."""
    step = np.where(np.arange(sh_rest.shape[1]) < 3, 8, 16)[:, None]
    nearest = np.floor((np.rint(sh_rest * 128) + 128 + step // 2) / step) * step
    return np.clip(nearest, 0, 255).astype(np.uint8)
