"""Opening image files from untrusted sources; files that would take too long are rejected."""

import logging
import os
import re
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from PIL import Image, features

from snowsplat.util.errors import Problem, cause_of
from snowsplat.util.files import GIT_LFS
from snowsplat.util.messages import Message, message

logger = logging.getLogger(__name__)

#: Formats that depend on how Pillow was built.
OPTIONAL_FORMATS = ("AVIF",) if features.check("avif") else ()
#: Formats of photos (Pillow opens the MPO files of phones as JPEG). Other formats are excluded,
#: because Pillow starts external programs for some of them.
PHOTO_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "HEIF", "BMP", "PPM", *OPTIONAL_FORMATS)
#: The largest number of pixels of an image: Pillow's own limit. The largest camera backs have 151
#: million. The size is known before the image is decoded. Phones take 200 million: a JPEG of up to
#: four times as many is decoded at half its size; HEIC and AVIF, whose decoders cannot do that, are
#: decoded whole, one at a time, and halved at once.
MOST_PIXELS = 178_956_970
_MOST_PIXELS = dict.fromkeys(("JPEG", "MPO"), 4 * MOST_PIXELS)
_MOST_PIXELS |= dict.fromkeys(("HEIF", "AVIF"), 205_000_000)
Image.MAX_IMAGE_PIXELS = 2 * MOST_PIXELS  # Pillow refuses twice as many
_HEIF_BYTES = 9  # memory per pixel while HEIC (7) or AVIF is decoded whole
_one_whole = threading.Lock()
#: The largest width or height: that of the JPEG format.
LONGEST_SIDE = 65_535
#: The reason in the error for a larger image.
TOO_LARGE = message(
    "more than {millions} million pixels, or {side:,} a side; make it smaller",
    millions=MOST_PIXELS // 1_000_000,
    side=LONGEST_SIDE,
)
# Pixels in a tile of a TIFF. A tile may be larger than the image, but programs do not write tiles
# that are much larger.
_MOST_TILE_PIXELS = 1 << 22
# Pixels times scans of a JPEG. A scan has few bytes, but it takes time for each pixel of the image.
# No program writes as many scans for an image of that size.
_MOST_SCANNED_PIXELS = 3_000_000_000
# Segments of a JPEG or chunks of a PNG. Pillow takes microseconds for each of them.
_MOST_SEGMENTS = 100_000
# Bytes before the pixels of a JPEG. Phones store complete photos there. Pillow may take a
# microsecond per byte.
_LONGEST_HEADER = 8 << 20
# The marker at the start of a JPEG segment. The excluded markers have no length: they are part of
# the data of a scan, or decoders skip them (TEM, 0x01).
_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")
_SCAN = b"\xff\xda"  # start of a scan
_END = b"\xff\xd9"  # end of the image
# Starts of a frame that FFmpeg decodes, if a channel has 8 bits.
_FRAMES, _BITS = (b"\xff\xc0", b"\xff\xc1", b"\xff\xc2"), 8
# Metadata, which may have faults of their own: APP0 to APP15, but that of Adobe, and comments.
_METADATA = {bytes([0xFF, 0xE0 + n]) for n in range(16)} - {b"\xff\xee"} | {b"\xff\xfe"}
_REDUCED = "3"  # decode at 1/2³ of the size, which is several times faster
# The bytes at the end of a JPEG among which its end is searched: some programs add a few.
_TAIL = 1 << 12
_JPEG = b"\xff\xd8"  # the first bytes of a JPEG
_PNG = b"\x89PNG\r\n\x1a\n"  # the first bytes of a PNG


def open_image(
    path: Path, formats: Sequence[str], *, header_only: bool = False, page: int = 0
) -> Image.Image:
    """Open an image file without decoding its pixels.

    Args:
        path: the file.
        formats: the formats to accept, by Pillow's names.
        header_only: the caller does not decode the pixels, so the scans of a JPEG are not checked.
            If the file does not end as it should, it is decoded here.
        page: which page of a file with several, from 0.

    Raises:
        ValueError: larger than `MOST_PIXELS` (JPEG, HEIC, AVIF: see there) or `LONGEST_SIDE`, or
            malicious.
        Exception: anything that Pillow raises for a damaged file.
    """
    with open(path, "rb") as file:
        if file.read(8)[4:] == b"ftyp":
            from pillow_heif import register_heif_opener

            register_heif_opener()
        else:  # Pillow may not know HEIF yet
            formats = [name for name in formats if name != "HEIF"]
        file.seek(0)
        complete = _check_header(file)
    image: Image.Image = Image.open(path, formats=list(formats))
    try:
        if page:
            image.seek(page)
        _check_size(image, os.path.getsize(path))
        if image.format in ("JPEG", "MPO") and not (header_only and complete):
            scans = sum(marker == _SCAN for marker, *_ in _segments(path.read_bytes()))
            if scans * image.width * image.height > _MOST_SCANNED_PIXELS:
                raise Problem("too many scans ({scans}) for its size", scans=scans)
        if header_only and not complete:  # a copy that was interrupted, or bytes after the image
            with Image.open(path, formats=list(formats)) as whole:
                whole.draft(None, (1, 1))
                whole.load()
        if image.width * image.height > MOST_PIXELS:
            image = _halved(image, path, header_only)
    except BaseException:
        image.close()
        raise
    return image


def _halved(image: Image.Image, path: Path, header_only: bool) -> Image.Image:
    width, height = image.size
    if image.format in ("JPEG", "MPO"):
        image.draft(None, (width // 2, height // 2))
    elif header_only:
        image._size = -(-width // 2), -(-height // 2)  # as `reduce` rounds
    else:
        with _one_whole, image:
            gigabytes = _HEIF_BYTES * width * height / 1e9
            logger.info("%s: is decoded whole and halved: %.1f GB of memory", path, gigabytes)
            half = image.reduce(2)
        half.format = image.format
        return half
    return image


def reason_of(error: Exception) -> Message:
    """A short reason why an image cannot be read, from an error of Pillow or `open_image`."""
    if isinstance(error, Image.UnidentifiedImageError):
        return message("not an image of a known format")
    if isinstance(error, Image.DecompressionBombError):
        return TOO_LARGE
    if isinstance(error, Problem) or getattr(error, "strerror", None):
        return cause_of(error)
    return Message(" ".join(str(error).split())[:120] or type(error).__name__)


def _check_header(file: BinaryIO) -> bool:
    """Whether the file ends as its format requires; True if that is not known."""
    if file.read(len(GIT_LFS)) == GIT_LFS:
        raise Problem("is a pointer of Git LFS; run git lfs pull")
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    start = file.read(len(_PNG))
    if start == _PNG:
        for _ in range(_MOST_SEGMENTS):
            head = file.read(8)  # length and name of a chunk; 4 bytes of checksum follow its data
            if len(head) < 8 or head[4:] == b"IEND":
                return len(head) == 8
            file.seek(int.from_bytes(head[:4], "big") + 4, 1)
        raise Problem("too many chunks")
    if start.startswith(_JPEG):
        header = start + file.read(_LONGEST_HEADER)
        if len(header) > _LONGEST_HEADER and all(
            marker != _SCAN for marker, *_ in _segments(header)
        ):
            raise Problem("too many bytes before its pixels")
        file.seek(max(0, size - _TAIL))
        return _END in file.read(_TAIL)
    return not start.startswith(b"RIFF") or int.from_bytes(start[4:], "little") + 8 <= size


def _check_size(image: Image.Image, size: int) -> None:
    """``size``: of the file in bytes."""
    width, height = image.size
    most = _MOST_PIXELS.get(image.format or "", MOST_PIXELS)
    if width * height > most or max(width, height) > LONGEST_SIDE:
        raise Problem(TOO_LARGE)
    # Pillow's decoders in Python take a second per million pixels, and one of them does not check
    # the offsets in the file.
    if any(tile[0] in Image.DECODERS for tile in getattr(image, "tile", ())):
        raise Problem(
            "an uncommon kind of {format}, which is slow to read; save it as PNG",
            format=image.format,
        )
    if image.format == "TIFF":
        tags = getattr(image, "tag_v2", {})
        sides = [tags.get(tag, 1) for tag in (322, 323)]
        if not all(isinstance(side, int) for side in sides) or (
            sides[0] * sides[1] > max(_MOST_TILE_PIXELS, width * height)
        ):
            raise Problem("has tiles larger than the image")
        places, lengths = (tags.get(a) or tags.get(b) or () for a, b in ((273, 324), (279, 325)))
        if any(a + b > size for a, b in zip(places, lengths, strict=False)):
            raise Problem("its data ends early")


def _segments(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """The segments of a JPEG, up to the end of the image: the marker, the start and the end."""
    end = len(_JPEG)
    for _ in range(_MOST_SEGMENTS):
        marker = _MARKER.search(data, end)
        if marker is None or marker[0] == _END:
            return
        end = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
        yield marker[0], marker.start(), end
    raise Problem("too many segments")


def check_jpeg(path: Path) -> None:
    """Raises ValueError: the data of a JPEG file are damaged. Other files are not checked."""
    import av

    data = path.read_bytes()
    if not data.startswith(_JPEG):
        return
    needed, known = [_JPEG], False
    for marker, start, end in _segments(data):
        if marker == _SCAN:
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
