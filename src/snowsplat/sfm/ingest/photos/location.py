"""Where a photo was taken: GPS in EXIF, and in the XMP of drones.

    who writes it      where                                             what
    cameras, phones    EXIF, GPSLatitude, …                              rational degrees
    drones of DJI      XMP, drone-dji:GpsLatitude, AbsoluteAltitude, …   eight decimals
    the same with RTK  XMP, drone-dji:RtkStdLat, RtkStdLon               standard deviations
    for Pix4D          XMP, Camera:GPSXYAccuracy                         standard deviation

Some drones round the position in EXIF to whole arc seconds, which are 30 m: more than a flight over
a house. So the position in XMP is used, if it agrees with that in EXIF. Values are untrusted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from PIL.ExifTags import GPS

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
