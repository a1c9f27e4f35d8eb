"""What is wrong with single photos: blurred, too dark, too bright.

The photos in question had enough features for a pose; `ingest.sharpness` rejects those without any.
But a blurred photo still blurs the scene, and a photo without shadows or lights loses its colours.
"""

from __future__ import annotations

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


def problem_of(grey: np.ndarray) -> Problem | None:
    """What is wrong with a photo; None: nothing.

    ``grey``: (H, W) uint8, a copy of `SHARPNESS_SIDE`.
    """
    if np.quantile(grey, 0.95) < _DARK:
        return "dark"
    if (grey > _WHITE).mean() > _WHITE_SHARE:
        return "bright"
    return "blurred" if min(fine_detail(grey, SHARPNESS_SIDE)) < _LEAST_DETAIL else None


def problems(folder: Path, names: Iterable[str]) -> dict[str, Problem]:
    """The photos of a folder with a problem: names and `problem_of` them. Missing ones are skipped.

    Raises: OSError: a photo cannot be read.
    """
    found = {}
    for name in names:
        if not (folder / name).is_file():
            continue
        with Image.open(folder / name) as image:
            image.draft("L", (2 * SHARPNESS_SIDE, 2 * SHARPNESS_SIDE))  # faster JPEG decoding
            problem = problem_of(grey_copy(image, SHARPNESS_SIDE))
        if problem:
            found[name] = problem
    return found
