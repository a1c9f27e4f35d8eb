"""How a camera was held: gimbal angles in XMP, accelerometer and compass in EXIF.

    who writes it         where                                          what
    drones of DJI         XMP, drone-dji:GimbalPitchDegree, …            pitch, roll, yaw
    drones of Parrot      XMP, drone-parrot:CameraPitchDegree, …         the same
    phones of Apple       maker note, tag 8, AccelerationVector          the direction of gravity
    the app of Mapillary  ImageDescription, MAPAccelerometerVector       the direction of gravity
    phones                GPSImgDirection with the reference true north  the viewing direction

Values are untrusted: what is damaged, implausible or of another convention is ignored.
"""

import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, Base

from snowsplat.sfm.ingest.photo import Attitude, Direction

_ANGLE = rb'%s:(?:Gimbal|Camera)%sDegree(?:\s*=\s*["\']|>)\s*([-+]?[0-9.]+)'
_GIMBALS = (b"drone-dji", b"drone-parrot")
# The accelerometer also measures the movement of the hand. Then its length is not that of gravity.
_GRAVITY = (0.85, 1.15)  # in units of the acceleration of gravity
# A photo is level if this part of the unit vector is in the plane of the photo.
_STANDING = 0.7
_APPLE_NOTE, _APPLE_ACCELERATION = b"Apple iOS\0", 8
_SIGNED_RATIONAL = 10  # a type of TIFF: two integers of 32 bits

#: The axes x and y of the upright photo in those of the stored photo, by EXIF orientation. Mirrored
#: photos (2, 4, 5, 7) are not listed: no camera takes them.
UPRIGHT = {
    1: ((1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    6: ((0, -1), (1, 0)),
    8: ((0, 1), (-1, 0)),
}


def read_attitude(
    exif: Image.Exif,
    details: Mapping[int, Any],
    gps: Mapping[int, Any],
    xmp: bytes,
    orientation: int,
) -> Attitude | None:
    """The attitude of the upright photo; None if nothing is known.

    Args:
        exif, details, gps: the main tags, those of the exposure, and those of the position.
        xmp: the XMP packet; empty if there is none.
        orientation: EXIF value, 1 to 8, with which the photo was taken.
    """
    if orientation not in UPRIGHT:
        return None
    gimbal = _gimbal(xmp)
    if gimbal is not None:
        up, north = (_upright(direction, orientation) for direction in gimbal)
        return Attitude(_round(up), _round(north), gimbal=True)
    gravity = _apple_up(details)
    gravity = _mapillary_up(exif) if gravity is None else _upright(gravity, orientation)
    gravity = None if gravity is None else _standing(gravity)
    heading = _compass(gps)
    if gravity is None and heading is None:
        return None
    # North in the frame of a level camera that looks at this azimuth.
    facing = None if heading is None else np.array([-math.sin(heading), 0.0, math.cos(heading)])
    return Attitude(_round(gravity), _round(facing), gimbal=False)


def _gimbal(xmp: bytes) -> tuple[np.ndarray, np.ndarray] | None:
    """Up and north in the frame of the camera.

    Pitch is 0 at the horizon and −90° straight down; yaw is the azimuth, clockwise from north, of
    the viewing direction, or straight down that of the upper edge; roll turns about the optical
    axis.
    """
    for maker in _GIMBALS:
        found = [re.search(_ANGLE % (maker, name), xmp) for name in (b"Pitch", b"Roll", b"Yaw")]
        if all(found):
            try:
                pitch, roll, yaw = (math.radians(float(match[1])) for match in found if match)
            except ValueError:
                return None
            break
    else:
        return None
    # Directions as (east, north, up).
    east, north = math.sin(yaw), math.cos(yaw)
    forward = np.array([math.cos(pitch) * east, math.cos(pitch) * north, math.sin(pitch)])
    level = np.array([north, -east, 0.0])
    below = np.cross(forward, level)
    right = math.cos(roll) * level + math.sin(roll) * below
    down = np.cross(forward, right)
    axes = np.stack([right, down, forward])
    return axes[:, 2], axes[:, 1]


def _apple_up(details: Mapping[int, Any]) -> np.ndarray | None:
    """Up in the frame of the stored photo, from the maker note.

    Held upright, a phone at rest measures −1 along its y axis, which points to its top; x points
    to its right side and z to the person who holds it. The pixels are stored as the sensor lies: x
    of the photo points to the bottom of the phone, and y to its left side.
    """
    note = details.get(Base.MakerNote)
    front = "front" in str(details.get(Base.LensModel, "")).lower()  # another frame
    if front or not isinstance(note, bytes) or not note.startswith(_APPLE_NOTE):
        return None
    order = "<" if note[12:14] == b"II" else ">"
    try:
        (count,) = struct.unpack_from(f"{order}H", note, 14)
        for entry in range(min(count, 200)):
            tag, kind, values, start = struct.unpack_from(f"{order}HHII", note, 16 + 12 * entry)
            if (tag, kind, values) == (_APPLE_ACCELERATION, _SIGNED_RATIONAL, 3):
                numbers = struct.unpack_from(f"{order}6i", note, start)
                x, y, z = (numbers[i] / numbers[i + 1] for i in (0, 2, 4))
                return _of_gravity((y, x, z))
    except (struct.error, ZeroDivisionError):
        return None
    return None


def _mapillary_up(exif: Image.Exif) -> np.ndarray | None:
    """Up in the frame of the photo, apart from a quarter turn, from the description. The axes are
    those of the phone; the app has turned the photo, but not the vector."""
    description = exif.get(Base.ImageDescription)
    if not isinstance(description, str) or "MAPAccelerometerVector" not in description:
        return None
    try:
        vector = json.loads(description)["MAPAccelerometerVector"]
        x, y, z = (float(vector[axis]) for axis in "xyz")
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    # A photo that looks up or down does not tell the quarter turn.
    return _of_gravity((x, y, z)) if math.hypot(x, y) > _STANDING else None


def _compass(gps: Mapping[int, Any]) -> float | None:
    """Azimuth of the viewing direction in radians. Magnetic north differs by up to 20°: ignored."""
    if str(gps.get(GPS.GPSImgDirectionRef, "")).strip("\0 ") != "T":
        return None
    try:
        degrees = float(gps[GPS.GPSImgDirection])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return math.radians(degrees) if 0 <= degrees <= 360 else None


def _of_gravity(vector: Sequence[float]) -> np.ndarray | None:
    """The unit vector, if the length is that of gravity."""
    length = math.hypot(*vector)
    return np.array(vector) / length if _GRAVITY[0] < length < _GRAVITY[1] else None


def _standing(up: np.ndarray) -> np.ndarray:
    """``up`` turned by the quarters that make it point to the upper edge, if the photo is level.

    A phone stores which edge is the upper one. Where a level photo does not stand, another program
    has turned the pixels later, without the vector.
    """
    x, y, z = up
    if math.hypot(x, y) < _STANDING:
        return up
    x, y = min(((x, y), (-y, x), (-x, -y), (y, -x)), key=lambda quarter: quarter[1])
    return np.array([x, y, z])


def _upright(direction: np.ndarray, orientation: int) -> np.ndarray:
    """A direction in the frame of the stored photo, in that of the upright photo."""
    x, y = np.array(UPRIGHT[orientation]) @ direction[:2]
    return np.array([x, y, direction[2]])


def _round(direction: np.ndarray | None) -> Direction | None:
    """A tuple for JSON. Six decimals are a ten-thousandth of a degree."""
    if direction is None:
        return None
    x, y, z = (round(float(value), 6) for value in direction)
    return x, y, z
