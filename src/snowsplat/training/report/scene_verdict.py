"""The verdict on a trained scene: does it look right from places that it was not trained on?

The held-out photos are the evidence. Their PSNR depends on the contrast of the photos, so the share
of the variance that the rendering explains decides; see `ViewMetrics.explained`. The comparison
with training photos tells why: if those look right, the scene lacks photos, not steps. What the
verdict on the photos only predicts has less weight.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from snowsplat.data.dataset import Dataset, View
from snowsplat.evaluation.metrics import Evaluation, ViewMetrics
from snowsplat.evaluation.verdict import Grade, Reason, Verdict
from snowsplat.training.starts.point_colors import point_pixels
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.names import first_names

#: The explained share of the typical held-out photo. At 0.9, the error is a third of the contrast
#: of the photo (1 / √10); at 0.75, a half: contours are doubled or missing.
_GOOD, _USABLE = 0.9, 0.75
#: If this share of the contours of the typical held-out photo is reproduced, none are doubled or
#: missing: only smooth areas, such as a white wall, differ. In 16 captures with right poses, it is
#: 0.49 to 0.97; if each camera is turned by a degree, 0.3 and less. Below the second value, they
#: are doubled or blurred, even where large areas make most of the contrast.
_CONTOURS, _DOUBLED = 0.6, 0.4
#: A single photo below this share shows something else than the scene.
_WRONG = 0.5
#: dB. Smaller errors, of 4 grey levels, are not visible: a white ceiling has less contrast.
_VISIBLE = 36.0
#: If the errors of held-out photos are larger than those of training photos by this factor, the
#: scene lacks photos. It is then made for these photos, and wrong elsewhere.
_LACKS_PHOTOS = 2.0
#: Below this SSIM, fine detail is blurred in held-out photos.
_SHARP = 0.7
#: A point is seen by few photos if at most this number of training photos shows it.
_FEW_PHOTOS = 2
#: Few photos explain a wrong photo if they see at least this share of its points.
_SELDOM = 0.4
#: With fewer held-out photos, these do not outweigh what the capture lacks.
_EVIDENCE = 3
#: Number of points whose photos are counted.
_POINTS = 2000

_MORE = message(
    "take more photos, closer together, also from the places of the worst held-out photos"
)
_CHECK = message(
    "train longer; if that does not help, check the camera poses in the report of the dataset"
)
_START = message("add a point cloud to the dataset, from which the scene starts, or train longer")
_CHANGED = message(
    "check the camera poses, and what moved or changed between the photos: there are enough photos"
)
#: With as many training photos, more of them are of use only where few show the scene.
_MANY_PHOTOS = 100


def scene_verdict(
    held_out: Evaluation,
    trained_on: Evaluation,
    dataset: Dataset,
    of_parts: Sequence[Reason] = (),
    capture: Verdict | None = None,
) -> Verdict:
    """The verdict.

    Args:
        held_out: of at least one held-out photo.
        trained_on: of at least one training photo.
        dataset: with the present cameras.
        of_parts: the reasons of the parts of the training, see `Part.report`.
        capture: the verdict on the photos of the dataset.
    """
    reasons = [
        *_new_views(held_out, trained_on, dataset),
        *_worst(held_out, dataset),
        *_sharpness(held_out),
        *of_parts,
        *(_in_this_scene(reason, held_out) for reason in (capture.reasons if capture else ())),
    ]
    return Verdict.of(reasons)


def _in_this_scene(reason: Reason, held_out: Evaluation) -> Reason:
    """A reason of the verdict on the photos, in view of the held-out photos.

    What these do not show is no fault of the scene, but limits it. A prediction that they refute is
    only a remark.
    """
    share, grade = _typical(held_out), reason.grade
    sure = share >= _GOOD and len(held_out.views) >= _EVIDENCE
    if grade == "poor" and (sure or (reason.predicted and share >= _USABLE)):
        grade = "usable"
    elif reason.predicted and sure and not _sharpness(held_out):
        return Reason("good", reason.text)
    return replace(reason, grade=grade)


def _new_views(held_out: Evaluation, trained_on: Evaluation, dataset: Dataset) -> list[Reason]:
    """Whether held-out photos are explained and, if not, why."""
    share, own = _typical(held_out), _typical(trained_on)
    if own < _USABLE:
        text = message(
            "the scene reproduces only {share:.0%} of the contrast of the photos that it was "
            "trained on ({psnr:.1f} dB)",
            share=own,
            psnr=_psnr(trained_on),
        )
        return [Reason("poor", text, _START if dataset.points is None else _CHECK)]
    values = {
        "share": share,
        "psnr": _psnr(held_out),
        "photos": plural("{n} photo", "{n} photos", n=len(held_out.views)),
    }
    if share >= _GOOD:
        text = message(
            "the scene reproduces {share:.0%} of the contrast of a typical held-out photo "
            "({psnr:.1f} dB, colour-aligned, {photos})",
            **values,
        )
        return [Reason("good", text)]
    text = message(
        "the scene reproduces only {share:.0%} of the contrast of a typical held-out photo "
        "({psnr:.1f} dB, colour-aligned, {photos})",
        **values,
    )
    grade: Grade = "poor" if share < _USABLE else "usable"
    contours = _contours(held_out)
    if grade == "poor" and contours >= _CONTOURS:
        grade = "usable"
        text = message(
            "{text}, but {contours:.0%} of that of contours: smooth areas have a wrong brightness",
            text=text,
            contours=contours,
        )
    factor = 10.0 ** ((_psnr(trained_on) - _psnr(held_out)) / 20.0)
    if factor < _LACKS_PHOTOS:
        return [Reason(grade, text)]
    text = message(
        "{text}; the error is {factor:.1f} times that of the photos that it was trained on",
        text=text,
        factor=factor,
    )
    worst = min(held_out.views, key=_share).name
    return [Reason(grade, text, _advice(worst, dataset))]


def _advice(name: str, dataset: Dataset) -> Message:
    """What helps a held-out photo that differs more than the photos that were trained on."""
    view = next((view for view in dataset.test if view.name == name), None)
    enough = len(dataset.train) >= _MANY_PHOTOS and dataset.points is not None
    if enough and view is not None and _seen_by_few(view, dataset) < _SELDOM:
        return _CHANGED
    return _MORE


def _worst(held_out: Evaluation, dataset: Dataset) -> list[Reason]:
    """The held-out photos that show something else than the scene, the worst first."""
    wrong = sorted(
        (v for v in held_out.views if _share(v) < _WRONG and v.psnr_aligned < _VISIBLE),
        key=lambda view: _share(view),
    )
    if not wrong:
        return []
    names = [f"{view.name} ({view.psnr_aligned:.1f} dB)" for view in wrong]
    text = message("the scene looks wrong in {names}", names=first_names(names, 3))
    views = {view.name: view for view in dataset.test}
    seldom = _seen_by_few(views[wrong[0].name], dataset) if wrong[0].name in views else 0.0
    if seldom >= _SELDOM:
        text = message(
            "{text}; {share:.0%} of what {name} shows is in at most two training photos",
            text=text,
            share=seldom,
            name=message("it") if len(wrong) == 1 else wrong[0].name,
        )
    return [Reason("usable", text, _advice(wrong[0].name, dataset))]


def _seen_by_few(view: View, dataset: Dataset) -> float:
    """The share of the points in a view that at most two training views show. A view is assumed to
    show what is inside its frame."""
    if dataset.points is None:
        return 0.0
    xyz = dataset.points.xyz[:: -(-len(dataset.points) // _POINTS)]
    inside = point_pixels(view.camera, xyz)[1]
    if not inside.any():
        return 0.0
    xyz = xyz[inside]
    counts = sum(point_pixels(other.camera, xyz)[1].long() for other in dataset.train)
    assert not isinstance(counts, int)
    return float((counts <= _FEW_PHOTOS).double().mean())


def _sharpness(held_out: Evaluation) -> list[Reason]:
    ssim = float(np.median([view.ssim for view in held_out.views]))
    if ssim >= _SHARP:
        if (contours := _contours(held_out)) >= _DOUBLED or _psnr(held_out) >= _VISIBLE:
            return []
        text = message(
            "contours are doubled or blurred in held-out photos: the scene reproduces only "
            "{contours:.0%} of their contrast",
            contours=contours,
        )
        return [Reason("usable", text, _CHECK)]
    return [
        Reason(
            "usable",
            message("fine detail is blurred in held-out photos (SSIM {ssim:.2f})", ssim=ssim),
        )
    ]


def _typical(evaluation: Evaluation) -> float:
    return max(0.0, float(np.median([_share(view) for view in evaluation.views])))


def _contours(evaluation: Evaluation) -> float:
    return float(np.median([view.contours or 0.0 for view in evaluation.views]))


def _psnr(evaluation: Evaluation) -> float:
    """The median of the colour-aligned PSNR, in dB; at most 60."""
    return min(60.0, float(np.median([view.psnr_aligned for view in evaluation.views])))


def _share(view: ViewMetrics) -> float:
    return 0.0 if view.explained is None else view.explained
