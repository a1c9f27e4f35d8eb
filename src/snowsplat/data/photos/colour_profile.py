"""Converts the colours of a photo to sRGB, from the ICC profile in its file or from its EXIF data.

A photo without a profile has the colours of sRGB. Phones write Display P3; cameras write Adobe RGB,
often without a profile: then only the EXIF data say it.
"""

import io
import logging
import struct
import threading
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms
from PIL.ExifTags import IFD, Interop

from snowsplat.data.photos.bit_depth import eight_bits

logger = logging.getLogger(__name__)

_TRANSPARENT = ("RGBA", "RGBa", "LA", "La", "PA")
# The mode of the pixels that a profile describes, by the colour space in its header.
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
# If no colour changes by more than so many of 255 levels, the profile is one of sRGB: its versions
# differ that much. Display P3 changes colours by up to 100.
_SAME_COLOURS = 2
# LittleCMS would interpolate a steep curve of grey from 33 points.
_EXACT = {"L": ImageCms.Flags.NOOPTIMIZE}
# What Pillow knows about the colours of a file; after the conversion, it is no longer true.
_COLOUR_INFO = ("icc_profile", "transparency")
# The version of EXIF's interoperability rules for Adobe RGB.
_ADOBE_RGB = "R03"

_told: set[str] = set()  # the lines that were logged: one for all photos of a camera
_lock = threading.Lock()


def is_transparent(image: Image.Image) -> bool:
    """Whether an image has an alpha channel or a transparent colour."""
    return image.mode in _TRANSPARENT or "transparency" in image.info


def plain_pixels(image: Image.Image, path: Path) -> Image.Image:
    """An image of 8 bits per channel in sRGB: mode L, RGB, or RGBA if pixels may be transparent.

    Arguments and errors are those of `eight_bits`.
    """
    return to_srgb(eight_bits(image, path), path)


def to_srgb(image: Image.Image, path: Path) -> Image.Image:
    """An image of 8 bits per channel in sRGB: mode L, RGB, or RGBA if it `is_transparent`.

    A damaged profile, or one for other pixels, is ignored; the log says so once.

    Args:
        image: the image, or a part that has its ``info``.
        path: its file, for the log.
    """
    grey = image.mode in ("1", "L") and not is_transparent(image)
    plain_mode = "RGBA" if is_transparent(image) else "L" if grey else "RGB"
    profile = image.info.get("icc_profile") or _profile_by_exif(image)
    if not isinstance(profile, bytes) or not profile:
        return _as_mode(image, plain_mode)
    pixels = "CMYK" if image.mode == "CMYK" else "L" if image.mode in ("1", "L", "LA") else "RGB"
    transform = _transform(profile, pixels)
    if isinstance(transform, str):
        _tell(f"{path}: its colour profile {transform}, so it is not used", profile)
    if not isinstance(transform, ImageCms.ImageCmsTransform):
        return _as_mode(image, plain_mode)
    given = image.convert("RGBA") if image.mode in ("RGBa", "PA", "P") else image
    converted = transform.apply(_as_mode(given, transform.input_mode))
    if plain_mode == "RGBA":
        converted.putalpha(image.convert("RGBA").getchannel("A"))
    converted = converted.getchannel("G") if grey else converted
    converted.info = {key: value for key, value in image.info.items() if key not in _COLOUR_INFO}
    return converted


def _as_mode(image: Image.Image, mode: str) -> Image.Image:
    if image.mode == mode:
        image.load()
        return image
    return image.convert(mode)


@lru_cache(maxsize=32)
def _transform(profile: bytes, pixels: str) -> ImageCms.ImageCmsTransform | str | None:
    """The conversion to sRGB; None if it changes no colour; or why the profile cannot be used.

    ``pixels``: the mode of the image: RGB, L or CMYK. Grey pixels may have a profile of colours.
    """
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = _MODES.get(source.profile.xcolor_space.strip(), "")
        if mode != pixels and (mode, pixels) != ("RGB", "L"):
            return "is not one for its pixels"
        transform = ImageCms.buildTransform(
            source,
            ImageCms.createProfile("sRGB"),
            mode,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            ImageCms.Flags.BLACKPOINTCOMPENSATION | _EXACT.get(mode, ImageCms.Flags.NONE),
        )
        chart = _chart(mode)
        change = np.abs(
            np.asarray(transform.apply(chart), np.int16) - np.asarray(chart.convert("RGB"))
        )
    except Exception:  # Pillow raises several kinds of exceptions for damaged profiles
        return "is damaged"
    return None if mode != "CMYK" and change.max() <= _SAME_COLOURS else transform


def _chart(mode: str) -> Image.Image:
    """All combinations of nine levels of each channel."""
    channels = len(Image.new(mode, (1, 1)).getbands())
    levels = np.rint(np.linspace(0, 255, 9)).astype(np.uint8)
    colours = np.stack(np.meshgrid(*[levels] * channels, indexing="ij"), axis=-1)
    flat = np.ascontiguousarray(colours.reshape(-1, 1, channels))
    return Image.frombytes(mode, (1, len(flat)), flat.tobytes())


def _tell(line: str, profile: bytes) -> None:
    """Log a warning, once for each profile: all photos of a camera have the same."""
    key = f"{hash(profile)}"
    with _lock:
        if key in _told:
            return
        _told.add(key)
    logger.warning("%s", line)


# Colour spaces without a profile


def _profile_by_exif(image: Image.Image) -> bytes | None:
    exif = image.info.get("exif")
    if not isinstance(exif, bytes) or _ADOBE_RGB.encode() + b"\0" not in exif:
        return None  # most photos; the search is much faster than reading EXIF data
    try:
        index = image.getexif().get_ifd(IFD.Interop).get(Interop.InteropIndex)
    except Exception:  # as in `_transform`
        return None
    return _adobe_rgb() if str(index).strip("\0 ") == _ADOBE_RGB else None


@lru_cache(maxsize=1)
def _adobe_rgb() -> bytes:
    """A minimal ICC profile, version 2, of Adobe RGB (1998): its primaries and its gamma."""
    # XYZ of the white point and of the primaries, adapted to the illuminant D50 of ICC profiles.
    points = {
        b"wtpt": (0.9642, 1.0, 0.8249),
        b"rXYZ": (0.60974, 0.31111, 0.01947),
        b"gXYZ": (0.20528, 0.62567, 0.06087),
        b"bXYZ": (0.14919, 0.06322, 0.74457),
    }
    white = _fixed_point(points[b"wtpt"])
    tags = {name: b"XYZ \0\0\0\0" + _fixed_point(point) for name, point in points.items()}
    gamma = b"curv" + struct.pack(">IIHH", 0, 1, round(2.19921875 * 256), 0)
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), gamma)
    start = 128 + 4 + 12 * len(tags)
    table, body = struct.pack(">I", len(tags)), b""
    for name, data in tags.items():
        table += struct.pack(">4sII", name, start + len(body), len(data))
        body += data
    head = struct.pack(">I4sI", start + len(body), b"\0" * 4, 0x02400000) + b"mntrRGB XYZ "
    head = (head.ljust(36, b"\0") + b"acsp").ljust(68, b"\0") + white
    return head.ljust(128, b"\0") + table + body


def _fixed_point(values: tuple[float, ...]) -> bytes:
    return b"".join(struct.pack(">i", round(65536 * value)) for value in values)
