"""Converts a photo from any format that cameras write to an upright one that COLMAP reads.

pycolmap 4.2 reads pixels as they are stored: it ignores the EXIF orientation. It cannot read WebP
and HEIC. A photo is linked or copied without a change if it is a JPEG, PNG or TIFF file with
upright pixels in 8-bit RGB or grey. All other photos are converted.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from PIL import Image, ImageOps
from PIL.ExifTags import Base

from snowsplat.data.photos import image_file
from snowsplat.data.photos.colour_profile import is_transparent, plain_pixels
from snowsplat.data.photos.image_file import PHOTO_FORMATS, check_jpeg, reason_of
from snowsplat.sfm.ingest.content.panorama import STITCHED, Panorama, panorama_in_xmp
from snowsplat.sfm.ingest.photos.exif import ExifInfo, exif_for_copy, read_exif
from snowsplat.util.errors import Problem
from snowsplat.util.image_size import scaled_size

# Formats that COLMAP reads, by file extension.
_SUFFIXES = {
    "JPEG": (".jpg", ".jpeg"),
    "MPO": (".jpg", ".jpeg"),
    "PNG": (".png",),
    "TIFF": (".tif", ".tiff"),
}
_LOSSY = ("JPEG", "MPO", "WEBP", "HEIF", "AVIF")
_MOST_PAGES = 1000  # of a file; further ones are not looked for
_ANIMATIONS = ("WEBP", "PNG", "AVIF")
_SMALLEST_SIDE = 32  # pixels; smaller images are icons


class Unusable(Problem):
    """The photo cannot be used; the message is the reason. Other photos are not affected."""


@dataclass(frozen=True)
class Header:
    """Properties of an image file that are known before it is decoded."""

    format: str  # Pillow's name
    width: int  # pixels, as stored
    height: int
    plain: bool  # 8 bits per channel; grey, RGB, or RGBA in a PNG
    transparent: bool  # has an alpha channel
    exif: ExifInfo
    #: The pages of the size of the first one, from 0: a scanner writes several photos to a TIFF.
    pages: tuple[int, ...] = (0,)
    animated: int = 1  # number of pictures of an animation, of which only the first is used
    panorama: Panorama | None = None  # if the metadata say so
    turned: int = 1  # the EXIF orientation that is ignored; see `as_stored`

    @property
    def sideways(self) -> bool:
        """Whether width and height are exchanged to display the photo upright."""
        return self.exif.orientation >= 5

    def size(self, longest: int | None) -> tuple[int, int]:
        """Width and height of the upright photo, with its longest side at most ``longest``."""
        width, height = (self.height, self.width) if self.sideways else (self.width, self.height)
        return scaled_size(width, height, longest)

    def is_ready(self, longest: int | None) -> bool:
        """Whether COLMAP can read the file unchanged, and its pixels are upright."""
        as_stored = self.size(longest) == (self.width, self.height)
        whole = self.panorama is None or not self.panorama.cropped
        upright = self.exif.orientation == 1 and as_stored
        ready = upright and whole and len(self.pages) == 1
        return self.format in _SUFFIXES and self.plain and ready

    def as_stored(self) -> Header:
        """The header if the pixels are used as stored: their orientation and depth are ignored.

        COLMAP reads photos so, and a model that it has made describes these pixels.
        """
        if self.format == "TIFF":  # Pillow turns its pixels
            return self
        exif = replace(self.exif, orientation=1)
        return replace(self, exif=exif, plain=True, turned=self.exif.orientation)

    def file_name(self, name: str, longest: int | None) -> str:
        """The name in ``input/``: the original name, with the extension of the new format."""
        lossy = self.format in _LOSSY and not self.transparent
        target = self.format if self.is_ready(longest) else "JPEG" if lossy else "PNG"
        path = PurePosixPath(name)
        fits = path.suffix.lower() in _SUFFIXES[target]
        return name if fits else str(path.with_suffix(_SUFFIXES[target][0]))


def read_header(path: Path) -> Header:
    """Read the header of a photo, without decoding it.

    Raises: Unusable: the format is unknown, or the photo is damaged, too small, or stitched.
    """
    try:
        with open_image(path, header_only=True) as image:
            # If a PNG has no EXIF data before its pixels, getexif() would decode the pixels, in
            # order to find EXIF data after them.
            has_exif = "exif" in image.info or image.format == "TIFF"
            exif = image.getexif() if has_exif else Image.Exif()
            transparent = is_transparent(image)
            plain_modes = ("L", "RGB", "RGBA") if image.format == "PNG" else ("L", "RGB")
            width, height = _stored_size(image)
            xmp = _xmp(image)
            panorama = panorama_in_xmp(xmp, width, height)
            header = Header(
                format=image.format or "",
                width=width,
                height=height,
                plain=image.mode in plain_modes
                and "transparency" not in image.info
                and _bits(path, image) == 8,
                transparent=transparent,
                exif=read_exif(exif, width, height, xmp, image.info.get("original_orientation")),
                panorama=panorama if isinstance(panorama, Panorama) else None,
                animated=getattr(image, "n_frames", 1) if image.format in _ANIMATIONS else 1,
                pages=_pages(image),  # the last, because it reads another page
            )
    except Exception as error:  # Pillow may raise any exception for a damaged file
        raise Unusable("cannot be decoded ({error})", error=reason_of(error)) from None
    if min(header.width, header.height) < _SMALLEST_SIDE:
        raise Unusable("has only {width}x{height} pixels", width=header.width, height=header.height)
    if panorama == STITCHED:
        raise Unusable(STITCHED)
    return header


def _pages(image: Image.Image) -> tuple[int, ...]:
    """The pages of the size of the first one. Smaller ones are previews of it."""
    if image.format != "TIFF":
        return (0,)
    pages, size = [0], image.size
    with suppress(Exception):  # EOFError after the last page; other errors if one is damaged
        for page in range(1, _MOST_PAGES):
            image.seek(page)
            if image.size == size:
                pages.append(page)
    return tuple(pages)


def _xmp(image: Image.Image) -> bytes:
    packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp")  # the latter: PNG
    packet = packet.encode() if isinstance(packet, str) else packet
    return packet if isinstance(packet, bytes) else b""


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the stored pixels. For a TIFF file, ``image.size`` is already rotated."""
    tags = getattr(image, "tag_v2", {})
    if image.format == "TIFF" and 256 in tags and 257 in tags:
        return tags[256], tags[257]
    return image.size


def _bits(path: Path, image: Image.Image) -> int:
    """Bits per channel in the file. The image mode does not show them, because Pillow converts
    16-bit colours to 8 bits."""
    if image.format == "PNG":
        with open(path, "rb") as file:
            return file.read(25)[24]  # bit depth in the first chunk, IHDR
    if image.format == "TIFF":
        bits = getattr(image, "tag_v2", {}).get(258, 8)
        return max(bits) if isinstance(bits, tuple) else bits
    return 8


def open_image(path: Path, *, header_only: bool = False, page: int = 0) -> Image.Image:
    """Open a photo; its pixels are decoded later. Raises the errors of `image_file.open_image`."""
    return image_file.open_image(path, PHOTO_FORMATS, header_only=header_only, page=page)


def decode(path: Path, header: Header, longest: int | None, page: int = 0) -> Image.Image:
    """The photo, upright and resized: mode L, RGB or, with transparent pixels, RGBA.

    Raises: Unusable: the photo is damaged.
    """
    try:
        check_jpeg(path)
        with open_image(path, page=page) as opened:
            image = plain_pixels(opened, path)
            if header.exif.orientation != 1:
                image = ImageOps.exif_transpose(image)
    except Exception as error:  # as in `read_header`
        raise Unusable("cannot be decoded ({error})", error=reason_of(error)) from None
    if image.mode == "RGBA" and image.getchannel("A").getextrema()[0] == 255:
        image = image.convert("RGB")
    return resize_photo(image, header.size(longest))


def decode_small(path: Path, side: int) -> Image.Image:
    """A small version of the photo, with its pixels as stored.

    A JPEG is reduced to at least twice ``side`` while it is decoded, which is much faster. Raises
    the errors of `decode`, because the whole file is read.
    """
    try:
        check_jpeg(path)
        with open_image(path) as opened:
            opened.draft("RGB", scaled_size(opened.width, opened.height, 2 * side))
            return plain_pixels(opened, path)
    except Exception as error:  # as in `read_header`
        raise Unusable("cannot be decoded ({error})", error=reason_of(error)) from None


def resize_photo(image: Image.Image, size: tuple[int, int]) -> Image.Image:
    """Resize with a Lanczos filter; colours of transparent pixels do not affect their neighbours.

    ``size``: width and height in pixels.
    """
    return image if image.size == size else image.resize(size, Image.Resampling.LANCZOS)


def save(image: Image.Image, path: Path, source: Path | None = None) -> None:
    """Write as JPEG (nearly lossless) or PNG, as the extension of ``path`` says.

    EXIF data are copied from the file ``source``, if it is given. The colours are those of sRGB.

    Raises:
        OSError: the disk is full.
    """
    extra: dict[str, bytes | None] = {"icc_profile": None}  # not the one in ``image.info``
    if source is not None:
        with open_image(source, header_only=True) as original:
            exif = exif_for_copy(original.getexif(), *image.size)
        if exif:
            extra["exif"] = exif
    if path.suffix.lower() == ".png":
        image.save(path, "PNG", compress_level=3, **extra)
    else:
        image.save(path, "JPEG", quality=95, subsampling=0, **extra)


def link_or_copy(source: Path, target: Path) -> None:
    """Create a hard link, or a copy if the file system does not support links."""
    source = source.resolve()
    with suppress(OSError):  # another disk, or no hard links
        os.link(source, target)
        return
    shutil.copyfile(source, target)


def turn_upright(image: Image.Image, orientation: int) -> Image.Image:
    """Rotate and mirror an image as the EXIF ``orientation`` (1 to 8) says."""
    exif = image.getexif()
    exif[Base.Orientation] = orientation
    return ImageOps.exif_transpose(image)
