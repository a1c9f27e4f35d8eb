"""`lens_findings`: whether the intrinsics of a pinhole camera are those of a real one."""

from __future__ import annotations

import math

from snowsplat.data.judge.finding import Finding

# Degrees, of the longer side of a photo. A pinhole image of more than 150° has less than a
# seventh of its pixels within the central 60°: no lens is corrected to that. Below 5° (more than
# 400 mm on a full-frame camera) are telescopes and satellites.
_WIDEST, _NARROWEST = 150.0, 5.0
# A telescope on a camera has about 0.5°; below is a unit that is not the pixel.
_NARROWEST_TELESCOPE = 0.1
# fx / fy. Sensors have square pixels within 0.1%; calibration is good to 1 or 2%. Some videos are
# anamorphic or were scaled in one direction.
_SQUARE = 0.97, 1.03
# Distance of the principal point from the centre, relative to the size of the photo. Cropping
# moves it.
_OFF_CENTRE = 0.2
# Ratio to the focal length of the EXIF data. Undistortion, and the rounding to a whole millimetre,
# change it by a few percent; another lens or zoom by more.
_AS_KNOWN = 0.75, 1.25


def field_of_view(size: float, focal: float) -> float:
    """The angle in degrees that ``size`` pixels span at a focal length in pixels."""
    return 2.0 * math.degrees(math.atan(0.5 * size / focal))


def lens_findings(
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    *,
    known_focal: float | None = None,
) -> list[Finding]:
    """What is impossible or doubtful about the intrinsics of a pinhole camera.

    Args:
        width, height: of the photo in pixels.
        fx, fy: positive focal lengths in pixels.
        cx, cy: the principal point in pixels from the upper left corner.
        known_focal: the focal length in pixels from another source, such as the EXIF data.
    """
    return [
        *_field_of_view(width, height, fx, fy),
        *_aspect(fx, fy),
        *_principal_point(width, height, cx, cy),
        *_known_focal(math.sqrt(fx * fy), known_focal),
    ]


def _field_of_view(width: int, height: int, fx: float, fy: float) -> list[Finding]:
    angle = max(field_of_view(width, fx), field_of_view(height, fy))
    if _NARROWEST <= angle <= _WIDEST:
        return []
    text = (
        f"a focal length of {fx:.5g} pixels for photos of {width}x{height} is a field of view of "
        f"{angle:.3g}°"
    )
    if angle > _WIDEST:
        text += "; a pinhole camera has less than 150°; the focal length must be in pixels"
        return [Finding("field of view", text, impossible=True)]
    text += "; the focal length must be in pixels of these photos"
    return [Finding("field of view", text, impossible=angle < _NARROWEST_TELESCOPE)]


def _aspect(fx: float, fy: float) -> list[Finding]:
    if _SQUARE[0] <= fx / fy <= _SQUARE[1]:
        return []
    text = f"fx is {fx / fy:.3f} of fy, but pixels are square ({fx:.5g} and {fy:.5g})"
    return [Finding("pixel aspect", text)]


def _principal_point(width: int, height: int, cx: float, cy: float) -> list[Finding]:
    where = f"the principal point ({cx:.5g}, {cy:.5g})"
    size = f"photos of {width}x{height}"
    if not (0.0 <= cx <= width and 0.0 <= cy <= height):
        text = f"{where} is outside of {size}; it must be in pixels of these photos"
        return [Finding("principal point", text, impossible=True)]
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    if off <= _OFF_CENTRE:
        return []
    text = f"{where} is {off:.0%} of the size away from the centre of {size}"
    return [Finding("principal point", text)]


def _known_focal(focal: float, known: float | None) -> list[Finding]:
    if known is None or _AS_KNOWN[0] <= focal / known <= _AS_KNOWN[1]:
        return []
    text = (
        f"the focal length is {focal:.5g} pixels, but {known:.5g} by the EXIF data of the photos "
        f"({focal / known:.2f} of it)"
    )
    return [Finding("focal length", text)]
