"""Whether the intrinsics of a camera can be those of a lens.

A dataset may have been made by another program, or converted by a script with a mistake. Structure
from motion may return an arbitrary lens, too, if the photos do not determine it. A training run
with such a lens makes a bent scene, and no error appears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# In degrees, along the longer side: from a 400 mm telephoto lens (on 35 mm film) to the widest
# rectilinear lens of 10 mm. Beyond the second limits, a number is wrong: the unit, or a digit.
_USUAL_VIEW = (5.0, 125.0)
_POSSIBLE_VIEW = (0.5, 160.0)
# fx / fy: pixels of cameras are square. Photos that were stretched may differ more.
_SQUARE, _STRETCHED = 1.03, 2.5
# Distance of the principal point from the middle, in units of the width or height. The distance is
# larger if photos were cropped on one side.
_CENTRAL = 0.2
# The estimate of a focal length and that in EXIF agree if their ratio is less than this. EXIF has
# it in whole millimetres, for the uncropped photo.
_AGREES_WITH_EXIF = 1.25


@dataclass(frozen=True)
class Finding:
    """A reason to doubt the cameras of a dataset.

    Attributes:
        about: a short name, such as "focal length".
        text: the reason with its numbers, as text for users, without a full stop.
        impossible: no scene can agree with it; otherwise it is unusual.
    """

    about: str
    text: str
    impossible: bool


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
    """What is impossible or unusual about a pinhole camera; an empty list: nothing.

    Args:
        width, height: of the photo, in pixels.
        fx, fy, cx, cy: focal lengths and principal point, in pixels.
        known_focal: the focal length in EXIF, in pixels.
    """
    found = []
    view = 2 * math.degrees(math.atan(max(width / fx, height / fy) / 2))
    if not _USUAL_VIEW[0] <= view <= _USUAL_VIEW[1]:
        found.append(
            Finding(
                "focal length",
                f"the focal length of {max(fx, fy):.4g} pixels for photos of {width}x{height} "
                f"is a field of view of {view:.3g}°",
                not _POSSIBLE_VIEW[0] <= view <= _POSSIBLE_VIEW[1],
            )
        )
    ratio = max(fx / fy, fy / fx)
    if ratio > _SQUARE:
        found.append(
            Finding(
                "pixels",
                f"the pixels are not square: fx is {fx:.5g} and fy {fy:.5g} pixels",
                ratio > _STRETCHED,
            )
        )
    offset = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    if offset > _CENTRAL:
        found.append(
            Finding(
                "principal point",
                f"the principal point is at {cx:.5g}, {cy:.5g}, and the middle of the photo at "
                f"{width / 2:g}, {height / 2:g}",
                offset > 0.5,
            )
        )
    if known_focal is not None:
        focal = math.sqrt(fx * fy)
        if max(focal / known_focal, known_focal / focal) > _AGREES_WITH_EXIF:
            found.append(
                Finding(
                    "focal length in EXIF",
                    f"the focal length is {focal:.0f} pixels, but {known_focal:.0f} in EXIF",
                    False,
                )
            )
    return found
