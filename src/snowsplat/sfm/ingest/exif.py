"""What a camera noted in a photo: itself, its focal length, where it was."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image

ORIENTATION = 0x0112
_MAKE, _MODEL = 0x010F, 0x0110
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_FOCAL_LENGTH, _FOCAL_35MM = 0x920A, 0xA405
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_MAKER_NOTE, _USER_COMMENT, _PIXEL_WIDTH, _PIXEL_HEIGHT = 0x927C, 0x9286, 0xA002, 0xA003
_PLANE_UNITS_IN_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FULL_FRAME_DIAGONAL = 43.2666  # mm, of 36×24


@dataclass(frozen=True)
class Notes:
    """What a photo says of the camera. ``focal`` is in pixels of the photo as stored."""

    orientation: int = 1  # EXIF's 1 to 8
    camera: str = ""  # make, model, and the focal lengths as noted: one zoom of one lens
    focal: float | None = None
    location: tuple[float, float, float] | None = None  # latitude, longitude (degrees), m


def read_notes(exif: Image.Exif, width: int, height: int) -> Notes:
    """The notes of a photo of this size. What is absent or makes no sense is left out."""
    details, gps = _ifd(exif, _EXIF_IFD), _ifd(exif, _GPS_IFD)
    orientation = exif.get(ORIENTATION, 1)
    named = [str(exif.get(tag) or "").strip("\0 ") for tag in (_MAKE, _MODEL)]
    zoom = [_number(details.get(tag)) for tag in (_FOCAL_LENGTH, _FOCAL_35MM)]
    return Notes(
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=" ".join([*filter(None, named), *(f"{f:g} mm" for f in zoom if f)]),
        focal=_focal(details, width, height),
        location=_location(gps),
    )


def _focal(details: Mapping[int, Any], width: int, height: int) -> float | None:
    """Pixels, from what is reliable of the two ways in which cameras note it.

    The equivalent on 35 mm film is taken by the diagonals, as COLMAP does. The other is the focal
    length over the size of a pixel, which belongs to a picture of a noted size: one that was scaled
    later keeps the notes of the original.
    """
    focal = None
    equivalent, length = _number(details.get(_FOCAL_35MM)), _number(details.get(_FOCAL_LENGTH))
    density = _number(details.get(_PLANE_X))
    unit = _PLANE_UNITS_IN_MM.get(details.get(_PLANE_UNIT, 2))
    if equivalent:
        focal = equivalent / _FULL_FRAME_DIAGONAL * math.hypot(width, height)
    elif length and density and unit:
        sizes = [_number(details.get(tag)) for tag in (_PIXEL_WIDTH, _PIXEL_HEIGHT)]
        original = max((size for size in sizes if size), default=max(width, height))
        focal = length * density / unit * max(width, height) / original
    # Beyond a field of view of 150° or below 1.5° it is a number that somebody forgot to set.
    plausible = focal is not None and 0.13 < focal / max(width, height) < 40
    return focal if plausible else None


def _location(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    latitude = _degrees(gps.get(2), gps.get(1), "S")
    longitude = _degrees(gps.get(4), gps.get(3), "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    if latitude == 0 and longitude == 0:  # what a receiver without satellites notes
        return None
    altitude = _number(gps.get(6)) or 0.0
    below_sea = gps.get(5) in (1, b"\x01")
    return latitude, longitude, -altitude if below_sea else altitude


def _degrees(value: Any, side: Any, negative: str) -> float | None:
    if not isinstance(value, tuple | list) or len(value) != 3:
        return None
    parts = [_number(part, zero=True) for part in value]
    if any(part is None for part in parts):
        return None
    degrees = sum(part / 60**i for i, part in enumerate(parts) if part)
    return -degrees if str(side).strip("\0 ").upper() == negative else degrees


def _number(value: Any, zero: bool = False) -> float | None:
    """A positive finite number (or 0, where that is one), else None: tags hold anything."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and (number > 0 or (zero and number == 0)) else None


def _ifd(exif: Image.Exif, tag: int) -> Mapping[int, Any]:
    try:
        return exif.get_ifd(tag)
    except Exception:  # damaged notes raise anything; the pixels may be good
        return {}


def notes_for_copy(exif: Image.Exif, width: int, height: int) -> bytes:
    """The same notes for the picture turned upright, of this size; empty if they do not fit."""
    try:
        kept = Image.Exif()
        kept.load(exif.tobytes())
        kept[ORIENTATION] = 1
        details = kept.get_ifd(_EXIF_IFD)
        # A maker's note has offsets into the old file; the density of pixels was the old one's.
        for tag in (_MAKER_NOTE, _USER_COMMENT, _PLANE_X, _PLANE_X + 1, _PLANE_UNIT):
            details.pop(tag, None)
        details[_PIXEL_WIDTH], details[_PIXEL_HEIGHT] = width, height
        content = kept.tobytes()
    except Exception:  # as above
        return b""
    return content if len(content) < 65000 else b""  # what fits into a JPEG
