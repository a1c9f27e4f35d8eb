"""Whether photos were taken with a fisheye lens, decided from their matches before the mapping.

The matches of two photos agree with a relative pose only in the right kind of lens. A fundamental
matrix describes the matches of any two pinhole cameras, whatever their focal lengths: it has seven
parameters. An essential matrix of equidistant fisheye lenses (r = f θ) has five, if the focal
length is given. So for photos of an ordinary lens, fewer matches agree with the second one; if more
of them agree with it, then the lens is a fisheye. Of a few focal lengths, the one with which the
most matches agree is near enough for bundle adjustment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import closing_database, match_counts
from snowsplat.sfm.colmap.features.extraction import SEED
from snowsplat.sfm.colmap.lenses.lens import Lens, camera_ids
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.messages import Message, message

# Focal lengths divided by the longest side of a photo. At the ends, the longest side spans 290° and
# 55°: an image circle in a wide frame, and a lens that is hardly a fisheye.
_FOCALS = (0.2, 0.27, 0.37, 0.5, 0.67, 0.9, 1.2)
# Matches that agree with a fisheye lens / with pinhole cameras. Measured: 1.04 or more for fisheye
# lenses from 110° to 190°, 1.002 or less for ordinary photos (18 captures of 480 pixels).
_MIN_GAIN = 1.02
# A lens whose longest side spans less (75°) is no fisheye, but may have a barrel distortion, which
# the models of ordinary lenses describe.
_LONGEST_FOCAL = 0.75
_PAIRS = 10  # of each camera
_MIN_MATCHES = 60  # of a pair
_MIN_AGREEING = 300  # matches of all pairs of a camera
# In pixels of the resized photo in which the features were detected. With a larger error, a wrong
# lens explains most matches, too. Before, matches that are false in any lens are removed.
_MAX_ERROR, _MAX_ERROR_OF_ANY = 1.0, 12.0
# A pair with a smaller share of true matches is not used: RANSAC could miss the better lens.
_MIN_TRUE = 0.6
_TRIALS = 300


@dataclass(frozen=True)
class LensEvidence:
    """What the matches say about the lens of a camera."""

    focal: float  # in pixels, of the equidistant fisheye lens with which the most matches agree
    gain: float  # the number of these matches, divided by that of pinhole cameras
    fisheye: bool  # whether it is a fisheye lens


def lens_evidence(database: Path, photos: Sequence[Photo], scale: float) -> dict[int, LensEvidence]:
    """The evidence about each camera, by camera id; cameras with too few matches are left out.

    Args:
        database: with features and matches, which need not be verified.
        photos: the photo with the index i has the image id i + 1.
        scale: size of a photo / size at which its features were detected.
    """
    cameras = camera_ids(photos)
    pairs: dict[int, list[tuple[int, int]]] = {}
    for (i, j), count in sorted(match_counts(database).items(), key=lambda entry: -entry[1]):
        if cameras[i] == cameras[j] and count >= _MIN_MATCHES and not photos[i].panorama:
            pairs.setdefault(cameras[i], []).append((i, j))
    found = {}
    with closing_database(database) as source:
        for camera, own in pairs.items():
            # The strongest pairs are nearly the same photo twice. The weak ones are mostly false.
            half = own[: max(_PAIRS, len(own) // 2)]
            spread = np.linspace(0, len(half) - 1, min(_PAIRS, len(half)), dtype=int)
            true = [_true_matches(source, half[k], scale) for k in spread]
            matches = [pair for pair in true if pair is not None]
            evidence = _compare_lenses(matches, photos[own[0][0]], _MAX_ERROR * scale)
            if evidence is not None:
                found[camera] = evidence
    return found


_Matches = tuple[NDArray[np.float64], NDArray[np.float64]]  # (M, 2) pixels in each of two photos


def _true_matches(
    source: pycolmap.Database, pair: tuple[int, int], scale: float
) -> _Matches | None:
    """The matches of two photos without those that are false in any lens; None: most are false."""
    rows = source.read_matches(pair[0] + 1, pair[1] + 1)
    one, two = (
        source.read_keypoints(index + 1)[rows[:, k], :2].astype(np.float64)
        for k, index in enumerate(pair)
    )
    rough = pycolmap.estimate_fundamental_matrix(one, two, _ransac(_MAX_ERROR_OF_ANY * scale))
    if rough is None or rough["num_inliers"] < _MIN_TRUE * len(rows):
        return None
    kept = rough["inlier_mask"]
    return one[kept], two[kept]


def _compare_lenses(
    matches: Sequence[_Matches], photo: Photo, max_error: float
) -> LensEvidence | None:
    options = _ransac(max_error)

    def agreeing(estimate: dict[str, int] | None) -> int:
        return estimate["num_inliers"] if estimate else 0

    pinhole = sum(
        agreeing(pycolmap.estimate_fundamental_matrix(one, two, options)) for one, two in matches
    )
    if pinhole < _MIN_AGREEING:
        return None
    counts = {}
    for focal in (ratio * max(photo.width, photo.height) for ratio in _FOCALS):
        lens = pycolmap.Camera.create_from_model_name(
            1, "SIMPLE_FISHEYE", focal, photo.width, photo.height
        )
        counts[focal] = sum(
            agreeing(pycolmap.estimate_essential_matrix(one, two, lens, lens, options))
            for one, two in matches
        )
    best = max(counts, key=lambda focal: counts[focal])
    gain = counts[best] / pinhole
    wide = best <= _LONGEST_FOCAL * max(photo.width, photo.height)
    return LensEvidence(best, gain, wide and gain >= _MIN_GAIN)


def _ransac(max_error: float) -> pycolmap.RANSACOptions:
    options = pycolmap.RANSACOptions()
    options.max_error = max_error
    options.min_inlier_ratio = 0.5
    options.min_num_trials, options.max_num_trials = 50, _TRIALS
    options.random_seed = SEED
    return options


def describe_fisheye(
    lens: Lens, photos: Sequence[Photo], evidence: Mapping[int, LensEvidence]
) -> str:
    """`SfmResult.fisheye` of a model that began with ``lens``; ``evidence`` by camera id."""
    if not lens.fisheyes:
        return ""
    count = sum(number in lens.fisheyes for number in camera_ids(photos))
    which = "the photos are" if count == len(photos) else f"{count} photos are"
    found = [evidence[n].gain for n in lens.fisheyes if n in evidence and evidence[n].fisheye]
    if len(found) < len(lens.fisheyes):
        return f"{which} from a fisheye lens: the picture is a disc"
    return (
        f"{which} from a fisheye lens: {min(found) - 1:.0%} more matches agree with one than with "
        "any ordinary lens"
    )


def doubts_about_fisheye(
    lens: Lens, photos: Sequence[Photo], evidence: Mapping[int, LensEvidence], bent: bool
) -> list[Message]:
    """A doubt, if the photos seem to be from a fisheye lens, but the model has an ordinary one.

    The model FOV describes fisheye lenses, too. An endoscope shows a disc without one: if the model
    is not ``bent``, there is no doubt.
    """
    if lens.any_fisheye or lens.model == "FOV":
        return []
    disc = bent and any(photo.circle for photo in photos)
    if not disc and not any(found.fisheye for found in evidence.values()):
        return []
    return [
        message(
            "the photos seem to be from a fisheye lens, but their poses were estimated with an "
            "ordinary one; state the camera model OPENCV_FISHEYE"
        )
    ]
