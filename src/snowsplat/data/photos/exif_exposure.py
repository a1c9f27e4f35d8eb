"""The exposure of a photo, from its EXIF data."""

from __future__ import annotations

import math
from pathlib import Path

from PIL import Image
from PIL.ExifTags import IFD, Base

_TAGS = (Base.ExposureTime, Base.FNumber, Base.ISOSpeedRatings)


def exif_exposure(path: Path) -> float | None:
    """How much light the sensor recorded of a given scene, in EV: log₂(t · ISO / N²).

    One more means a photo of twice the brightness. The zero point is arbitrary.

    Returns: None if exposure time t, f-number N or ISO is missing or not positive, or the file
    cannot be read.
    """
    try:
        with Image.open(path) as image:
            # Without EXIF data before the pixels of a PNG, getexif() would decode them.
            if "exif" not in image.info:
                return None
            details = image.getexif().get_ifd(IFD.Exif)
        time, stop, iso = (float(details[tag]) for tag in _TAGS)
        return math.log2(time * iso / stop**2)
    except Exception:  # Pillow raises many kinds of exceptions for damaged files
        return None
