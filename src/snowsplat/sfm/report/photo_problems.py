"""What is wrong with single photos: blurred, too dark, too bright.

The photos in question had enough features for a pose; `ingest.sharpness` rejects those without any.
But a blurred photo still blurs the scene, and a photo without shadows or lights loses its colours.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image

from snowsplat.sfm.ingest.content.sharpness import SHARPNESS_SIDE, fine_detail, grey_copy
from snowsplat.util.messages import Message, message

# A photo with less detail in one direction is blurred; see `fine_detail`. Of 30 photos of five real
# datasets, 500 to 1000 pixels wide, the least value is 0.46. If they are blurred by a Gaussian
# filter with σ = 0.2% of their width, the largest value is 0.31; with σ = 0.1%, 0.51. If they are
# blurred by motion over 0.8% of their width, the values are 0.22 to 0.46; over 1.6%, 0.13 to 0.28.
_LEAST_DETAIL = 0.35
# But skin, white tables and gloss are smooth: a photo is blurred only if those beside it, which
# show about the same, have more detail: both those before it and those after it, as a path may
# come close to something smooth. In 21 captures without blurred photos, the ratio to the upper
# quartile of the eight nearest has a median of 0.86 to 1.00, and the standard deviation of its
# logarithm is at most 0.15 (0.20 in one with a shallow focus): e^(-3 * 0.14) is the limit.
_BESIDE = 4
_LEAST_RATIO = 0.65
# Grey levels, 0 to 255. A photo is too dark if 95% of it are below the first one; it is too bright
# if a quarter of it is above the second one. A white wall is usually at 200 to 240.
_DARK, _WHITE = 70, 251
_WHITE_SHARE = 0.25

Problem = Literal["blurred", "dark", "bright"]


class _Texts(NamedTuple):
    what: Message  # is wrong with a photo
    advice: Message


PROBLEMS: dict[Problem, _Texts] = {
    "blurred": _Texts(
        message("is blurred"), message("hold the camera still, or take it in more light")
    ),
    "dark": _Texts(message("is too dark"), message("use more light, or a longer exposure")),
    "bright": _Texts(
        message("is too bright: large parts are pure white"), message("use a shorter exposure")
    ),
}


def what_to_do(problem: Problem) -> Message:
    """What is wrong with a photo, and what to do."""
    what, advice = PROBLEMS[problem]
    return message("{what}; {advice}", what=what, advice=advice)


def problems_of(greys: Iterable[np.ndarray]) -> list[Problem | None]:
    """What is wrong with each photo of a capture, in the order in which they were taken.

    ``greys``: (H, W) uint8, copies of `SHARPNESS_SIDE`. None: nothing is wrong.
    """
    found: list[Problem | None] = []
    details = []
    for grey in greys:
        dark = np.quantile(grey, 0.95) < _DARK
        bright = (grey > _WHITE).mean() > _WHITE_SHARE
        found.append("dark" if dark else "bright" if bright else None)
        details.append(min(fine_detail(grey, SHARPNESS_SIDE)))
    for i, detail in enumerate(details):
        if found[i] is None and detail < _LEAST_DETAIL:
            sides = details[max(0, i - _BESIDE) : i], details[i + 1 : i + 1 + _BESIDE]
            if all(detail < _LEAST_RATIO * np.quantile(side, 0.75) for side in sides if side):
                found[i] = "blurred"
    return found


def problems(folder: Path, names: Iterable[str]) -> dict[str, Problem]:
    """The photos of a folder with a problem, see `problems_of`. Missing ones are skipped.

    ``names``: relative to the folder, in the order in which the photos were taken.

    Raises: OSError: a photo cannot be read.
    """
    there = [name for name in names if (folder / name).is_file()]
    found = problems_of(small_grey(folder / name) for name in there)
    return {name: problem for name, problem in zip(there, found, strict=True) if problem}


def small_grey(photo: Path) -> np.ndarray:
    """(H, W) uint8 copy of `SHARPNESS_SIDE`. Raises OSError: the photo cannot be read."""
    with Image.open(photo) as image:
        image.draft("L", (2 * SHARPNESS_SIDE, 2 * SHARPNESS_SIDE))  # faster JPEG decoding
        return grey_copy(image, SHARPNESS_SIDE)
