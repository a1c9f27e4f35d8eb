"""Whether the pixels of an image file are damaged.

For damaged data of a JPEG, libjpeg only has a warning, which Pillow drops: the rest of the photo is
grey or has other colours. FFmpeg has an error. Neither notices a changed byte that gives other
valid codes. PNG and TIFF by deflate have checksums. In WebP, AVIF and HEIC nearly all codes are
valid, and in formats without compression all of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snowsplat.data.photos.image_file import SCAN, segments
from snowsplat.util.errors import Problem

_SOI = b"\xff\xd8"
# Starts of a frame that FFmpeg decodes, if a channel has 8 bits.
_FRAMES, _BITS = (b"\xff\xc0", b"\xff\xc1", b"\xff\xc2"), 8
# Metadata, which may have faults of their own: APP0 to APP15, but that of Adobe, and comments.
_METADATA = {bytes([0xFF, 0xE0 + n]) for n in range(16)} - {b"\xff\xee"} | {b"\xff\xfe"}
# Tags of a TIFF: the compression, its values for deflate, places and sizes of strips and tiles.
_COMPRESSION, _DEFLATE, _PARTS = 259, (8, 32946), ((273, 279), (324, 325))
_BLOCK = 1 << 20  # bytes that are unpacked at once
_REDUCED = "3"  # decode at 1/2³ of the size, which is several times faster


def check_pixels(path: Path) -> None:
    """Raises UserError: the image file is missing, or its data are damaged."""
    from snowsplat.data.photos.decode import open_photo  # imports torch

    with open_photo(path) as image:
        if image.format == "PNG":
            image.verify()  # by its checksums
            return
        if image.format in ("JPEG", "MPO"):
            check_jpeg(path)
            image.draft(None, (1, 1))
        tags = getattr(image, "tag_v2", {})
        if tags.get(_COMPRESSION) in _DEFLATE:
            _check_deflate(path, tags)
        image.load()


def _check_deflate(path: Path, tags: Mapping[int, Any]) -> None:
    """Raises zlib.error, Problem: a part of a TIFF file does not have its checksum."""
    with open(path, "rb") as file:
        for places, sizes in _PARTS:
            for place, size in zip(tags.get(places, ()), tags.get(sizes, ()), strict=False):
                file.seek(place)
                packed, part = file.read(size), zlib.decompressobj()
                while packed and not part.eof:
                    part.decompress(packed, _BLOCK)
                    packed = part.unconsumed_tail
                if not part.eof:
                    raise Problem("its data are damaged")


def check_jpeg(path: Path) -> None:
    """Raises ValueError: the data of a JPEG file are damaged. Other files are not checked."""
    import av

    data = path.read_bytes()
    if not data.startswith(_SOI):
        return
    needed, known = [_SOI], False
    for marker, start, end in segments(data):
        if marker == SCAN:
            needed.append(data[start:])
            break
        known |= marker in _FRAMES and data[start + 4 : start + 5] == bytes([_BITS])
        if marker not in _METADATA:
            needed.append(data[start:end])
    if not known:
        return
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode", "lowres": _REDUCED}
    decoder.thread_count = 1
    try:
        decoder.decode(av.Packet(b"".join(needed)))
    except av.InvalidDataError:
        raise Problem("its data are damaged") from None
    except av.FFmpegError:  # a kind that it does not know
        pass
