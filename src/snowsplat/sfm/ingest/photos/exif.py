"""Metadata of a photo: orientation, camera, focal length, location and attitude."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base

from snowsplat.sfm.ingest.photo import Attitude
from snowsplat.sfm.ingest.photos.attitude import read_attitude
from snowsplat.sfm.ingest.photos.location import Location, number, read_location

_SRGB = 1
_PLANE_UNITS_IN_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FULL_FRAME_DIAGONAL = 43.2666  # mm, of 36×24
# Focal lengths divided by the longest side: fields of view of 150° and 1.5°. Values beyond them
# were not set correctly.
_WIDEST, _NARROWEST = 0.13, 40
_JPEG_LIMIT = 65000  # bytes of EXIF that fit into a JPEG segment


@dataclass(frozen=True)
class ExifInfo:
    """The metadata that snowsplat uses."""

    orientation: int = 1  # EXIF value, 1 to 8
    camera: str = ""  # make, model and focal lengths, which identify a lens and its zoom
    focal: float | None = None  # pixels of the stored photo, before any resizing
    location: Location | None = None  # latitude, longitude (°), altitude (m)
    location_error: float | None = None  # m, horizontal, as the receiver states it
    attitude: Attitude | None = None  # in the frame of the upright photo


def read_exif(
    exif: Image.Exif, width: int, height: int, xmp: bytes = b"", taken: int | None = None
) -> ExifInfo:
    """Read the metadata of a photo with ``width`` × ``height`` stored pixels.

    ``xmp`` is the XMP packet of the file, in which drones store positions and gimbal angles.
    ``taken`` is the orientation with which the photo was taken, if the pixels have been turned
    since, as in a HEIC file that is open.

    Missing and implausible values have the default of `ExifInfo`.
    """
    details, gps = _ifd(exif, IFD.Exif), _ifd(exif, IFD.GPSInfo)
    stored = exif.get(Base.Orientation, 1)
    orientation = stored if stored in range(1, 9) else 1
    named = [str(exif.get(tag) or "").strip("\0 ") for tag in (Base.Make, Base.Model)]
    zoom = [number(details.get(tag)) for tag in (Base.FocalLength, Base.FocalLengthIn35mmFilm)]
    location, location_error = read_location(gps, xmp)
    return ExifInfo(
        orientation=orientation,
        camera=" ".join([*filter(None, named), *(f"{f:g} mm" for f in zoom if f)]),
        focal=_focal(details, width, height),
        location=location,
        location_error=location_error,
        attitude=read_attitude(exif, details, gps, xmp, taken or orientation),
    )


def _focal(details: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length in pixels, or None if it is unknown or implausible.

    Cameras store the focal length in one of two ways. A 35 mm equivalent is converted by the ratio
    of the diagonals, as in COLMAP. A focal length in mm is divided by the pixel size. This size is
    that of the original pixels: if a program has resized the photo, the metadata may still describe
    the original. Therefore the result is multiplied by the ratio of the longest sides.
    """
    focal = None
    equivalent = number(details.get(Base.FocalLengthIn35mmFilm))
    length = number(details.get(Base.FocalLength))
    density = number(details.get(Base.FocalPlaneXResolution))
    unit = _PLANE_UNITS_IN_MM.get(details.get(Base.FocalPlaneResolutionUnit, 2))
    if equivalent:
        focal = equivalent / _FULL_FRAME_DIAGONAL * math.hypot(width, height)
    elif length and density and unit:
        sizes = [number(details.get(tag)) for tag in (Base.ExifImageWidth, Base.ExifImageHeight)]
        original = max((size for size in sizes if size), default=max(width, height))
        focal = length * density / unit * max(width, height) / original
    plausible = focal is not None and _WIDEST < focal / max(width, height) < _NARROWEST
    return focal if plausible else None


def _ifd(exif: Image.Exif, tag: int) -> Mapping[int, Any]:
    try:
        return exif.get_ifd(tag)
    except Exception:  # damaged metadata may raise any exception, but the pixels may be valid
        return {}


def exif_for_copy(exif: Image.Exif, width: int, height: int) -> bytes:
    """EXIF data for a copy of a photo that is upright, in sRGB, and has this size.

    Empty if the data are damaged or do not fit into a JPEG file.
    """
    try:
        copy = Image.Exif()
        copy.load(exif.tobytes())
        copy[Base.Orientation] = 1
        details = copy.get_ifd(IFD.Exif)
        # A maker note contains offsets into the old file. The pixels per unit may have changed.
        plane = (Base.FocalPlaneXResolution, Base.FocalPlaneYResolution)
        for tag in (Base.MakerNote, Base.UserComment, *plane, Base.FocalPlaneResolutionUnit):
            details.pop(tag, None)
        details[Base.ExifImageWidth], details[Base.ExifImageHeight] = width, height
        details[Base.ColorSpace] = _SRGB
        details.pop(IFD.Interop, None)  # it may say that the colours are those of Adobe RGB
        content = copy.tobytes()
    except Exception:  # as in `_ifd`
        return b""
    return content if len(content) < _JPEG_LIMIT else b""
