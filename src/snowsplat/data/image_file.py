"""Opening an image file that anybody may have made: what would take too long is refused before."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from PIL import Image

#: The largest image that is read; its size is known before it is decoded. Pillow's own limit, which
#: is enough for the backs of the largest cameras (151 million) and the sides of any JPEG.
MOST_PIXELS, LONGEST_SIDE = 178_956_970, 65_535
TOO_LARGE = (
    f"more than {MOST_PIXELS // 1_000_000} million pixels, or {LONGEST_SIDE:,} a side; make it "
    "smaller"
)
# A tile of a TIFF may be larger than the image; a scan of a JPEG costs time for each pixel, and few
# bytes. Both are far above what any program writes for an image of that size.
_MOST_TILE_PIXELS, _MOST_SCANNED_PIXELS = 1 << 22, 3_000_000_000
# Of a JPEG or PNG, and bytes before the pixels of a JPEG, where phones put whole photos. Pillow
# takes microseconds for each of the first, and may take one for each of the others.
_MOST_SEGMENTS, _LONGEST_HEADER = 100_000, 8 << 20
# What begins a segment of a JPEG; those that this leaves out have no length, and are in the data of
# a scan, or (TEM, 01) passed over by decoders.
_MARKER, _SCAN, _END = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]"), b"\xff\xda", b"\xff\xd9"
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"


def open_image(path: Path, formats: Sequence[str], *, header_only: bool = False) -> Image.Image:
    """An image file whose pixels are not yet read; with ``header_only`` they must not be.

    Raises:
        ValueError: larger than `MOST_PIXELS` or `LONGEST_SIDE`, or made to do harm. And whatever
            Pillow raises on damaged files.
    """
    with open(path, "rb") as file:
        _check_header(file)
    image = Image.open(path, formats=list(formats))
    try:
        _check(image)
        if not header_only and image.format in ("JPEG", "MPO"):
            _check_scans(image, path)
    except BaseException:
        image.close()
        raise
    return image


def reason_of(error: Exception) -> str:
    """Why an image cannot be read, in a few words, from what Pillow or `open_image` raised."""
    if isinstance(error, Image.UnidentifiedImageError):
        return "not an image of a known format"
    if isinstance(error, Image.DecompressionBombError):
        return TOO_LARGE
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())[:120] or type(error).__name__


def _check_header(file: BinaryIO) -> None:
    start = file.read(len(_PNG))
    if start == _PNG:
        for _ in range(_MOST_SEGMENTS):
            head = file.read(8)  # length and name of a chunk, whose checksum comes after it
            if len(head) < 8 or head[4:] == b"IEND":
                return
            file.seek(int.from_bytes(head[:4], "big") + 4, 1)
        raise ValueError("absurdly many chunks")
    if start.startswith(_JPEG):
        header = start + file.read(_LONGEST_HEADER)
        if len(header) > _LONGEST_HEADER and _SCAN not in _segments(header):
            raise ValueError("absurdly much before its pixels")


def _check(image: Image.Image) -> None:
    width, height = image.size
    if width * height > MOST_PIXELS or max(width, height) > LONGEST_SIDE:
        raise ValueError(TOO_LARGE)
    # Decoders in Python take a second for a million pixels; one of them trusts any skip it reads.
    if any(tile[0] in Image.DECODERS for tile in getattr(image, "tile", ())):
        raise ValueError(f"a {image.format} of a kind that is slow to read; save it as PNG")
    if image.format == "TIFF":
        tags = getattr(image, "tag_v2", {})
        sides = [tags.get(tag, 1) for tag in (322, 323)]
        if not all(isinstance(side, int) for side in sides) or (
            sides[0] * sides[1] > max(_MOST_TILE_PIXELS, width * height)
        ):
            raise ValueError("has tiles larger than the image")


def _check_scans(image: Image.Image, path: Path) -> None:
    scans = sum(marker == _SCAN for marker in _segments(path.read_bytes()))
    if scans * image.width * image.height > _MOST_SCANNED_PIXELS:
        raise ValueError(f"{scans} scans of all its pixels")


def _segments(data: bytes) -> Iterator[bytes]:
    """The markers of a JPEG, up to its end."""
    at = len(_JPEG)
    for _ in range(_MOST_SEGMENTS):
        marker = _MARKER.search(data, at)
        if marker is None or marker[0] == _END:
            return
        yield marker[0]
        at = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    raise ValueError("absurdly many segments")
