"""The container of an `.spz` file: its header and its columns as bytes, packed and unpacked.

Versions 1 to 3 have a header of 16 bytes and the columns, compressed by gzip (some tools write them
uncompressed). Version 4 has a header of 32 bytes, extensions, a table with the packed and
unpacked size of each column, and the columns, each in a zstd stream; empty columns are omitted.

The sizes that a file declares are compared with the size of the file before memory is allocated.
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import zstandard

from snowsplat.formats.damage import Damaged, Unsupported
from snowsplat.formats.packing import check_count

#: Bits of `Header.flags`.
ANTIALIASED = 1
EXTENDED = 2
LEVELS = 0x80  # of Spark

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEAD = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fraction, flags, streams
_HEADER_BYTES = 32  # of version 4
_SPARK = bytes.fromhex("1f8b08000000000000ff")  # other writers of .spz name a system in the last
_EXTENSION_LIMIT = 1 << 16

_GZIP_LEVEL = 4
_ZSTD_LEVEL = 5


@dataclass
class Header:
    """The first 15 bytes; the 16th is the number of streams, 0 before version 4."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    def columns(self) -> list[int]:
        """Bytes per Gaussian of position, opacity, colour, scales, rotation, SH."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return [position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1)]


@dataclass
class Contents:
    """The unpacked columns of position, opacity, colour, scales, rotation, SH.

    Invariant: each column has the size that follows from the header.
    """

    header: Header
    columns: list[bytes]
    extensions: bytes


def is_spz(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is an .spz file of any version."""
    if head.startswith(_GZIP):
        try:
            head, _ = _gunzip(head, len(_MAGIC))
        except zlib.error:
            return False
    return head.startswith(_MAGIC)


def is_of_spark(data: bytes) -> bool:
    """Whether Spark 2 seems to have written the file content ``data``."""
    return data.startswith(_SPARK)


def read_header(data: bytes) -> Header:
    """The header of the file content ``data``.

    Raises: Unsupported: another version, a damaged header, or an implausible number of Gaussians.
    """
    head = data
    try:
        if data.startswith(_GZIP):
            head, _ = _gunzip(data, _HEAD.size)
        return _header(head, len(data))
    except (zlib.error, struct.error):
        raise _damaged() from None


def unpack(data: bytes) -> Contents:
    """The columns of the file content ``data``.

    Raises: Unsupported: see `read_header`; or the file is damaged or truncated.
    """
    try:
        return _unpack(data)
    except (zlib.error, zstandard.ZstdError, struct.error):
        raise _damaged() from None


def _unpack(data: bytes) -> Contents:
    if not data.startswith(_GZIP):
        header = _header(data, len(data))
        if header.version > 3:
            return _unpack_streams(data, header)
        body = data[_HEAD.size :]
        size = _body_bytes(header)
    else:
        header = _header(_gunzip(data, _HEAD.size)[0], len(data))
        size = _body_bytes(header)
        content, complete = _gunzip(data, _HEAD.size + size + _EXTENSION_LIMIT)
        if header.version > 3 or not complete:
            raise _damaged()
        body = content[_HEAD.size :]
    if len(body) < size:
        raise _damaged()
    columns, start = [], 0
    for width in header.columns():
        columns.append(body[start : start + width * header.count])
        start += width * header.count
    return Contents(header, columns, body[size:] if header.flags & EXTENDED else b"")


def _gunzip(data: bytes, most: int) -> tuple[bytes, bool]:
    """At most ``most`` bytes, at least one, of a gzip file, which may have several members; and
    whether they are complete: the checksum is verified at the end of a member."""
    parts: list[bytes] = []
    while data.startswith(_GZIP) and most > 0:
        stream = zlib.decompressobj(31)
        parts.append(stream.decompress(data, most))
        if not stream.eof:
            return b"".join(parts), False
        most -= len(parts[-1])
        data = stream.unused_data
    return b"".join(parts), not data.startswith(_GZIP)


def _body_bytes(header: Header) -> int:
    return sum(header.columns()) * header.count


def _header(head: bytes, file_size: int) -> Header:
    if not head.startswith(_MAGIC):
        raise Unsupported("not an .spz file; its content does not begin with NGSP")
    _, *values, _ = _HEAD.unpack_from(head)
    header = Header(*values)
    if not 1 <= header.version <= 4:
        raise Unsupported(
            "version {version} of .spz; supported are 1 to 4",
            version=header.version,
        )
    if header.flags & LEVELS:
        raise Unsupported("a tree of levels of detail of Spark; use the file it was made from")
    if header.sh_degree > 4 or header.fractional_bits > 31:
        raise _damaged()
    check_count(header.count, file_size)
    return header


def _unpack_streams(data: bytes, header: Header) -> Contents:
    (table,) = struct.unpack_from("<I", data, _HEAD.size)
    sizes = [width * header.count for width in header.columns()]
    streams = sum(size > 0 for size in sizes)
    start = table + 16 * streams
    if table < _HEADER_BYTES or data[_HEAD.size - 1] != streams:
        raise _damaged()
    entry, columns = table, []
    for size in sizes:
        if not size:
            columns.append(b"")
            continue
        packed, unpacked = struct.unpack_from("<QQ", data, entry)
        if unpacked != size or start + packed > len(data):
            raise _damaged()
        # A stream reader is used, because decompress() trusts the size that the stream declares.
        unpacker = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        column = unpacker.stream_reader(data[start : start + packed]).read(size + 1)
        if len(column) != size:
            raise _damaged()
        columns.append(column)
        entry, start = entry + 16, start + packed
    end = min(table, _HEADER_BYTES + _EXTENSION_LIMIT)
    return Contents(header, columns, data[_HEADER_BYTES:end] if header.flags & EXTENDED else b"")


def pack(header: Header, columns: Sequence[bytes]) -> bytes:
    """The content of a file."""
    streams = [column for column in columns if column]
    count = len(streams) if header.version > 3 else 0
    head = _HEAD.pack(_MAGIC, *astuple(header), count)
    if header.version < 4:
        packer = zlib.compressobj(_GZIP_LEVEL, zlib.DEFLATED, 31)
        return b"".join([packer.compress(part) for part in (head, *streams)]) + packer.flush()
    packed = [zstandard.ZstdCompressor(_ZSTD_LEVEL).compress(stream) for stream in streams]
    sizes = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([head, struct.pack("<I12x", _HEADER_BYTES), *sizes, *packed])


def _damaged() -> Damaged:
    return Damaged("a damaged or incomplete .spz file")
