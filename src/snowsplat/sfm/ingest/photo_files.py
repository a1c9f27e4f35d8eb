"""One photo: from any file that cameras make to what COLMAP reads, upright.

COLMAP reads pixels as they are stored (measured with pycolmap 4.2: it neither turns by EXIF nor
knows WebP or HEIC), and so does all that follows. So what is not upright RGB or grey of 8 bits in a
JPEG, PNG or TIFF is written anew; all else is linked, byte for byte.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from snowsplat.data import image_file
from snowsplat.data.image_file import reason_of
from snowsplat.sfm.ingest.exif import ORIENTATION, Notes, notes_for_copy, read_notes

_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "HEIF", "BMP", "PPM")
# What COLMAP reads, and the endings that tell it so.
_SUFFIXES = {
    "JPEG": (".jpg", ".jpeg"),
    "MPO": (".jpg", ".jpeg"),
    "PNG": (".png",),
    "TIFF": (".tif", ".tiff"),
}
_LOSSY = ("JPEG", "MPO", "WEBP", "HEIF")
_TRANSPARENT = ("RGBA", "RGBa", "LA", "La", "PA")
_SMALLEST_SIDE = 32  # pixels: icons


class Unusable(Exception):
    """This photo cannot be used, for the reason that it says; the others can."""


@dataclass(frozen=True)
class Header:
    """What a photo's file says of it without being decoded."""

    format: str  # Pillow's name
    width: int  # pixels, as stored
    height: int
    plain: bool  # 8 bits a channel: grey, RGB, or RGBA in a PNG
    transparent: bool  # has a channel of alpha
    notes: Notes

    @property
    def sideways(self) -> bool:
        """Whether the picture is as wide as its file is high."""
        return self.notes.orientation >= 5

    def size(self, longest: int | None) -> tuple[int, int]:
        """Width and height of the picture upright, its longest side at most ``longest``."""
        width, height = (self.height, self.width) if self.sideways else (self.width, self.height)
        return scaled_size(width, height, longest)

    def is_ready(self, longest: int | None) -> bool:
        """Whether COLMAP can read the file as it is, and upright."""
        as_stored = self.size(longest) == (self.width, self.height)
        return self.format in _SUFFIXES and self.plain and self.notes.orientation == 1 and as_stored

    def file_name(self, name: str, longest: int | None) -> str:
        """The photo's name in ``input/``: its own, with the ending of the format it will have."""
        target = self.format if self.is_ready(longest) else self._new_format()
        path = PurePosixPath(name)
        fits = path.suffix.lower() in _SUFFIXES[target]
        return name if fits else str(path.with_suffix(_SUFFIXES[target][0]))

    def _new_format(self) -> str:
        return "JPEG" if self.format in _LOSSY and not self.transparent else "PNG"


def scaled_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """A size with its longest side at most ``longest``; never made larger."""
    if longest is None or max(width, height) <= longest:
        return width, height
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def read_header(path: Path) -> Header:
    """Of a photo; cheap.

    Raises:
        Unusable: not an image of a known format, or too small.
    """
    try:
        with open_image(path, header_only=True) as image:
            # Where a PNG has no such note up front, getexif() would decode all of it to find one.
            noted = "exif" in image.info or image.format == "TIFF"
            exif = image.getexif() if noted else Image.Exif()
            transparent = image.mode in _TRANSPARENT or "transparency" in image.info
            png = image.format == "PNG"
            width, height = _stored_size(image)
            header = Header(
                format=image.format or "",
                width=width,
                height=height,
                plain=image.mode in ("L", "RGB", *(["RGBA"] if png else []))
                and "transparency" not in image.info
                and _bits(path, image) == 8,
                transparent=transparent,
                notes=read_notes(exif, width, height),
            )
    except Exception as error:  # Pillow's parsers raise anything on damaged files
        raise Unusable(f"cannot be decoded ({reason_of(error)})") from None
    if min(header.width, header.height) < _SMALLEST_SIDE:
        raise Unusable(f"has only {header.width}x{header.height} pixels")
    return header


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Of the pixels in the file: Pillow turns TIFFs by itself, and gives their size turned."""
    tags = getattr(image, "tag_v2", {})
    if image.format == "TIFF" and 256 in tags and 257 in tags:
        return tags[256], tags[257]
    return image.size


def _bits(path: Path, image: Image.Image) -> int:
    """Bits a channel in the file: Pillow gives 16 of colour as 8 without a word."""
    if image.format == "PNG":
        with open(path, "rb") as file:
            return file.read(25)[24]  # of the first chunk, IHDR
    if image.format == "TIFF":
        bits = getattr(image, "tag_v2", {}).get(258, 8)
        return max(bits) if isinstance(bits, tuple) else bits
    return 8


def open_image(path: Path, *, header_only: bool = False) -> Image.Image:
    """A lazily read image of a format that photos have; raises as `image_file.open_image`."""
    from pillow_heif import register_heif_opener

    register_heif_opener()
    return image_file.open_image(path, _FORMATS, header_only=header_only)


def decode(path: Path, header: Header, longest: int | None) -> Image.Image:
    """The picture, upright and scaled: mode L, RGB or, where it is somewhere transparent, RGBA.

    Raises:
        Unusable: damaged.
    """
    try:
        with open_image(path) as opened:
            image = _eight_bits(ImageOps.exif_transpose(opened))
    except Exception as error:  # as above
        raise Unusable(f"cannot be decoded ({reason_of(error)})") from None
    if image.mode == "RGBA" and image.getchannel("A").getextrema()[0] == 255:
        image = image.convert("RGB")
    return resized(image, header.size(longest))


def decode_small(path: Path, side: int) -> Image.Image:
    """The picture as stored, but of a JPEG a smaller copy at least twice ``side``: much faster.

    Raises as `decode`: all of the file is read.
    """
    try:
        with open_image(path) as opened:
            opened.draft("RGB", scaled_size(opened.width, opened.height, 2 * side))
            return _eight_bits(opened)
    except Exception as error:  # as above
        raise Unusable(f"cannot be decoded ({reason_of(error)})") from None


def _eight_bits(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):  # 16-bit grey, which convert() would clip rather than scale
        values = np.clip(np.asarray(image).astype(np.int64) // 256, 0, 255)
        return Image.fromarray(values.astype(np.uint8))
    if image.mode == "F":
        raise ValueError("floating-point pixels")
    if image.mode in _TRANSPARENT or "transparency" in image.info:
        return image.convert("RGBA")
    image.load()
    return image if image.mode == "L" else image.convert("RGB")


def resized(image: Image.Image, size: tuple[int, int]) -> Image.Image:
    """By Lanczos; colours of what is transparent do not bleed."""
    return image if image.size == size else image.resize(size, Image.Resampling.LANCZOS)


def save(image: Image.Image, path: Path, source: Path | None = None) -> None:
    """Write as its ending says: JPEG with hardly any loss, or PNG; with the notes of ``source``.

    Raises:
        OSError: the disk is full.
    """
    extra: dict[str, bytes] = {}
    if source is not None:
        with open_image(source, header_only=True) as original:
            exif = notes_for_copy(original.getexif(), *image.size)
            profile = original.info.get("icc_profile")
            coloured = original.mode not in ("CMYK", "LAB", "I;16")
        extra = {"exif": exif} if exif else {}
        if profile and coloured:  # one of CMYK does not fit what has become RGB
            extra["icc_profile"] = profile
    if path.suffix.lower() == ".png":
        image.save(path, "PNG", compress_level=3, **extra)
    else:
        image.save(path, "JPEG", quality=95, subsampling=0, **extra)


def link_or_copy(source: Path, target: Path) -> None:
    """The same bytes under another name; a hard link where the disk allows it."""
    source = source.resolve()
    with suppress(OSError):  # another disk, or one without links
        os.link(source, target)
        return
    shutil.copyfile(source, target)


def turned(image: Image.Image, orientation: int) -> Image.Image:
    """Upright, from pixels stored with this EXIF orientation."""
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    return ImageOps.exif_transpose(image)
