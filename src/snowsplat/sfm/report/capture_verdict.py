"""The verdict on photos and their camera poses, before any training.

Each rule has a reason that does not depend on the scene. Lengths are relative to the distance
of the scene.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.evaluation.verdict import Grade, Reason, Verdict
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.options import EffortName
from snowsplat.sfm.report.coverage import Coverage
from snowsplat.sfm.report.photo_problems import PROBLEMS, Problem
from snowsplat.util.messages import as_message, message, plural

#: With fewer photos, no photo is left to check the poses and to hold out.
_TOO_FEW = 8
#: With fewer photos, at most every 12 degrees of a round is photographed.
_FEW = 30
#: Median step between photos, as a share of the distance of the scene. At a tenth, the views differ
#: by 6 degrees. At a fifth, 11 degrees, surfaces are hidden in one of two photos and seen in the
#: other. At a half, 27 degrees, features are rarely recognised.
_SMALL_STEP, _LARGE_STEP, _HUGE_STEP = 0.1, 0.2, 0.5
#: If less than this share of the points of a typical photo is confirmed by two other photos, most
#: of the scene is known from two photos only.
_CONFIRMED = 0.5
#: A photo at an end of the path is weak if its confirmed share is below this share of the median.
_WEAK_END = 0.6
#: Share of the photos without a pose from which it is told, and from which the rest is poor.
_SOME_LOST, _MANY_LOST = 0.05, 0.34
#: Share of the photos that are blurred, too dark or too bright, from which it is told.
_BAD_PHOTOS = 0.2
#: Optical axes within this angle, in degrees, show one side of a scene.
_ONE_SIDE = 15.0
#: The mean reprojection error of good poses is below 1 pixel.
_MAX_ERROR = 1.5
#: The agreement of poses with their matches (`SfmResult`) is 0.61 to 0.80 in bent models, and 0.92
#: or more in right ones.
_BENT = 0.86

_CLOSER = message(
    "move by at most a tenth of the distance to what you photograph from one photo to the next, so "
    "that every place is in at least five photos"
)


def few_photos(count: int) -> Reason | None:
    """The reason for a worse grade that the number of photos is; None: they are enough."""
    if count >= _FEW:
        return None
    advice = message("take 30 to 100 photos of an object or a room, and more of a larger place")
    if count < _TOO_FEW:
        too_few = message("{count} photos are too few", count=count)
        return Reason("poor", too_few, advice, predicted=True)
    return Reason("usable", message("{count} photos are few", count=count), advice, predicted=True)


def capture_verdict(
    coverage: Coverage,
    sfm: Mapping[str, Any],
    problems: Mapping[str, Problem],
    effort: EffortName = "best",
) -> Verdict:
    """The verdict.

    Args:
        coverage: of the photos with a pose.
        sfm: an `SfmResult` as JSON values. The entries "doubts" and "agreement" are optional.
        problems: photos that are blurred, too dark or too bright, and what is wrong.
        effort: with which the poses were estimated.
    """
    # A photo of a wide lens becomes several images.
    photos = min(len(sfm["registered"]), len(coverage.names))
    confirmed, step = _median(coverage.confirmed), _median(coverage.step)
    one_way = float(np.quantile(coverage.directions, 0.9)) < _ONE_SIDE
    reasons = list(_lost(sfm, effort))
    if not np.isnan(coverage.confirmed).all():  # the model has observations
        reasons += _distances(confirmed, step)
    # In a bent model, parts of the scene are doubled.
    grade: Grade = "poor" if sfm.get("agreement", 1.0) < _BENT else "usable"
    reasons += [Reason(grade, as_message(doubt)) for doubt in sfm.get("doubts", ())]
    few = few_photos(photos)
    # A few photos are enough for one side of a scene.
    if few and (few.grade == "poor" or not (one_way and step <= _SMALL_STEP)):
        reasons.append(few)
    if (places := len(set(coverage.place.tolist()))) < len(coverage.place):
        text = message(
            "{photos} photos are taken from {places} places, as brackets of exposures are: "
            "held-out photos may have been trained on at another exposure",
            photos=photos,
            places=places,
        )
        fewer = few_photos(places)
        reasons.append(Reason("usable", text, fewer.advice) if fewer else Reason("good", text))
    reasons += _ends(coverage, confirmed)
    error = sfm["reprojection_error"]
    if error is not None and error > _MAX_ERROR:
        text = message("the reprojection error is high: {error:.1f} pixels", error=error)
        advice = message(
            "leave out photos that are blurred or show moving objects, or try another --camera"
        )
        reasons.append(Reason("usable", text, advice, predicted=True))
    if problems and len(problems) >= _BAD_PHOTOS * len(coverage.names):
        most, number = Counter(problems.values()).most_common(1)[0]
        text = message(
            "{number} of {count} photos: each {what}",
            number=number,
            count=len(coverage.names),
            what=PROBLEMS[most].what,
        )
        reasons.append(Reason("usable", text, PROBLEMS[most].advice, predicted=True))
    if one_way:
        text = message(
            "all photos look in about the same direction: the scene can be seen from there only"
        )
        reasons.append(Reason("good", text))
    verdict = Verdict.of(reasons)
    if verdict.grade != "good":
        return verdict
    praise = message("{photos} photos", photos=photos)
    if confirmed > 0.0:
        praise = message(
            "{photos} photos; in a typical one, {share:.0%} of the points are in at least two "
            "others",
            photos=photos,
            share=confirmed,
        )
    return Verdict.of([Reason("good", praise), *reasons])


def recorded_verdict(dataset: Path) -> Verdict | None:
    """The verdict that the record of a dataset contains; None: there is none."""
    values = DatasetFolder(dataset).result("report").get("verdict")
    return None if values is None else Verdict.from_json(values)


def _lost(sfm: Mapping[str, Any], effort: EffortName) -> list[Reason]:
    lost, placed = len(sfm["unregistered"]), len(sfm["registered"])
    share = lost / max(lost + placed, 1)
    if share < _SOME_LOST:
        return []
    text = message("{lost} of {all} photos could not be placed", lost=lost, all=lost + placed)
    if (groups := len(sfm["sub_models"])) > 1:
        text = message(
            "{text}; the photos form {groups} groups without common points",
            text=text,
            groups=groups,
        )
    advice = message("take more photos between those that are placed and those that are not")
    if effort != "best":
        # Of 67 photos of a shiny thing on a carpet, draft has placed 21, and normal 55.
        advice = message(
            "try the quality {better}, which compares more of each photo; or {advice}",
            better="normal" if effort == "draft" else "best",
            advice=advice,
        )
    return [Reason("poor" if share >= _MANY_LOST else "usable", text, advice)]


def _distances(confirmed: float, step: float) -> list[Reason]:
    """The steps from photo to photo, and the points that only two photos show: typical values of
    `Coverage`."""
    reasons = []
    far = message(
        "the photos are far apart: the next one is typically {step:.0%} of the distance to the "
        "scene away",
        step=step,
    )
    if not np.isfinite(step):
        far = message("most photos have no other photo that shows the same")
    if confirmed < _CONFIRMED:
        why = message(
            "too few photos show the same: in a typical photo, {share:.0%} of the points are in "
            "only one other photo",
            share=1 - confirmed,
        )
        reasons.append(Reason("poor", why, _CLOSER, predicted=True))
    if step > _LARGE_STEP:
        grade: Grade = "poor" if step > _HUGE_STEP else "usable"
        reasons.append(Reason(grade, far, _CLOSER, predicted=True))
    return reasons


def _ends(coverage: Coverage, typical: float) -> list[Reason]:
    """The first and the last photo, by name, of a path. ``typical``: of `Coverage.confirmed`."""
    if len(coverage.names) < _TOO_FEW:
        return []
    least = _WEAK_END * typical
    weak = [coverage.names[i] for i in (0, -1) if coverage.confirmed[i] < least]
    if not weak:
        return []
    text = plural(
        "most of what {photos} shows, at the end of your path, is in only one other photo",
        "most of what {photos} show, at the end of your path, is in only one other photo",
        n=len(weak),
        photos=" + ".join(weak),
    )
    advice = message("begin earlier and end later than the place that you want to show")
    return [Reason("good", text, advice)]


def _median(values: Sequence[float] | np.ndarray) -> float:
    """The median of the values that are not NaN; 0 if there are none."""
    known = np.asarray(values)[~np.isnan(values)]
    return float(np.median(known)) if len(known) else 0.0
