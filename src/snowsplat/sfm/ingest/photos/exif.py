"""Metadata of a photo: orientation, camera, focal length, location and attitude.

    who writes a location  where                                             what
    cameras, phones        EXIF, GPSLatitude, …                              rational degrees
    drones of DJI          XMP, drone-dji:GpsLatitude, AbsoluteAltitude, …   eight decimals
    the same with RTK      XMP, drone-dji:RtkStdLat, RtkStdLon               standard deviations
    for Pix4D              XMP, Camera:GPSXYAccuracy                         standard deviation

Some drones round the position in EXIF to whole arc seconds, which are 30 m: more than a flight over
a house. So the position in XMP is used, if it agrees with that in EXIF. Values are untrusted.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from snowsplat.sfm.ingest.photo import Attitude
from snowsplat.sfm.ingest.photos.attitude import read_attitude

Location = tuple[float, float, float]  # latitude, longitude (°), altitude (m)

_VALUE = rb'%s(?:\s*=\s*["\']|>)\s*([-+]?[0-9]+(?:\.[0-9]+)?)'
# Firmware spells the names in several ways.
_LATITUDES = (b"drone-dji:GpsLatitude", b"drone-dji:Latitude")
_LONGITUDES = (b"drone-dji:GpsLongitude", b"drone-dji:GpsLongtitude", b"drone-dji:Longitude")
_ALTITUDE = b"drone-dji:AbsoluteAltitude"
_RTK_ERRORS = (b"drone-dji:RtkStdLat", b"drone-dji:RtkStdLon")
_ERROR = b"Camera:GPSXYAccuracy"
# Degrees: a position that is rounded to arc seconds agrees with an exact one within this.
_ROUNDED = 1.5 / 3600


def read_location(gps: Mapping[int, Any], xmp: bytes) -> tuple[Location | None, float | None]:
    """The location, and the standard deviation of a horizontal position in metres as the receiver
    states it; None for what is unknown.

    Args:
        gps: the EXIF tags of the position.
        xmp: the XMP packet; empty if there is none.
    """
    location, exact = _of_exif(gps), _of_xmp(xmp)
    stated = number(gps.get(GPS.GPSHPositioningError))
    if exact is None:
        return location, stated
    latitude, longitude, altitude = exact
    if location is not None:
        away = abs(latitude - location[0]), abs((longitude - location[1] + 180) % 360 - 180)
        if max(away) > _ROUNDED:  # a program has changed one of them
            return location, stated
        altitude = location[2] if altitude is None else altitude
    errors = [error for name in _RTK_ERRORS if (error := number(_xmp(xmp, name)))]
    error = max(errors) if len(errors) == 2 else number(_xmp(xmp, _ERROR))
    return (latitude, longitude, altitude or 0.0), error or stated


def _of_xmp(xmp: bytes) -> tuple[float, float, float | None] | None:
    """Latitude, longitude and, if it is known, altitude."""
    found = [
        next((value for name in names if (value := _xmp(xmp, name)) is not None), None)
        for names in (_LATITUDES, _LONGITUDES, (_ALTITUDE,))
    ]
    latitude, longitude, altitude = found
    if latitude is None or longitude is None or not _on_earth(latitude, longitude):
        return None
    return latitude, longitude, altitude


def _xmp(xmp: bytes, name: bytes) -> float | None:
    found = re.search(_VALUE % re.escape(name), xmp)
    return None if found is None else float(found[1])


def _of_exif(gps: Mapping[int, Any]) -> Location | None:
    latitude = _degrees(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), "S")
    longitude = _degrees(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), "W")
    if latitude is None or longitude is None or not _on_earth(latitude, longitude):
        return None
    altitude = number(gps.get(GPS.GPSAltitude)) or 0.0
    below_sea = gps.get(GPS.GPSAltitudeRef) in (1, b"\x01")
    return latitude, longitude, -altitude if below_sea else altitude


def _on_earth(latitude: float, longitude: float) -> bool:
    # Receivers store two zeros if they have no position.
    return abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)


def _degrees(value: Any, side: Any, negative: str) -> float | None:
    if not isinstance(value, tuple | list) or len(value) != 3:
        return None
    parts = [number(part, zero=True) for part in value]
    if any(part is None for part in parts):
        return None
    degrees = sum(part / 60**i for i, part in enumerate(parts) if part)
    return -degrees if str(side).strip("\0 ").upper() == negative else degrees


def number(value: Any, zero: bool = False) -> float | None:
    """A positive finite number (or 0 if ``zero``); None for all other values of a tag."""
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if math.isfinite(found) and (found > 0 or (zero and found == 0)) else None


_SRGB = 1
_PLANE_UNITS_IN_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FULL_FRAME_DIAGONAL = 43.2666  # mm, of 36×24
# Focal lengths divided by the longest side: fields of view of 150° and 1.5°. Values beyond them
# were not set correctly.
_WIDEST, _NARROWEST = 0.13, 40
_SAME_SHAPE = 0.02  # the largest difference of the logarithms of the ratio of the sides
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
    cropped: bool = False  # after the camera has stored the photo


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
        cropped=_is_cropped(details, width, height),
        location=location,
        location_error=location_error,
        attitude=read_attitude(exif, details, gps, xmp, taken or orientation),
    )


def _focal(details: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length in pixels, or None if it is unknown or implausible.

    Cameras store the focal length in one of two ways. A 35 mm equivalent is converted by the ratio
    of the diagonals, as in COLMAP. A focal length in mm is divided by the pixel size. This size is
    that of the original pixels: if a program has resized the photo, the metadata may still describe
    the original. Therefore the result is multiplied by the ratio of the longest sides. Both are of
    the whole photo, see `_uncropped`.
    """
    whole = _uncropped(details, width, height)
    if whole is None:
        return None
    focal = None
    equivalent = number(details.get(Base.FocalLengthIn35mmFilm))
    length = number(details.get(Base.FocalLength))
    density = number(details.get(Base.FocalPlaneXResolution))
    unit = _PLANE_UNITS_IN_MM.get(details.get(Base.FocalPlaneResolutionUnit, 2))
    if equivalent:
        focal = equivalent / _FULL_FRAME_DIAGONAL * math.hypot(*whole)
    elif length and density and unit:
        original = max(_original_size(details), default=max(whole))
        focal = length * density / unit * max(whole) / original
    plausible = focal is not None and _WIDEST < focal / max(width, height) < _NARROWEST
    return focal if plausible else None


def _original_size(details: Mapping[int, Any]) -> tuple[float, ...]:
    """What the camera has stored, in pixels: none to two sides."""
    sizes = (number(details.get(tag)) for tag in (Base.ExifImageWidth, Base.ExifImageHeight))
    return tuple(size for size in sizes if size)


def _uncropped(details: Mapping[int, Any], width: int, height: int) -> tuple[float, float] | None:
    """The longer and the shorter side of the whole photo in its pixels of today.

    A program that crops a photo keeps the metadata of the camera. Then the shape is another one,
    and what is left is assumed to be the largest part of the original that has this shape. None: it
    is larger than the original, as a picture that was made of several photos.
    """
    now, original = (max(width, height), min(width, height)), _original_size(details)
    if len(original) < 2:
        return now
    original = max(original), min(original)
    ratios = now[0] / original[0], now[1] / original[1]
    if abs(math.log(ratios[0] / ratios[1])) < _SAME_SHAPE:
        return now
    scale = max(ratios)
    return None if scale > 1.0 else (scale * original[0], scale * original[1])


def _is_cropped(details: Mapping[int, Any], width: int, height: int) -> bool:
    return _uncropped(details, width, height) != (max(width, height), min(width, height))


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
        if _is_cropped(details, width, height):
            details.pop(Base.FocalLengthIn35mmFilm, None)  # of the whole photo
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
