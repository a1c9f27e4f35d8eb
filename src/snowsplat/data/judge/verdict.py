"""`judge`: are the cameras and masks of a dataset possible? Asked before every training.

Four witnesses are heard, as far as the dataset has them:

- the numbers: lenses, positions (`lens_check`);
- the points: have they the colours of the photos where the cameras see them (`ColourEvidence`)?
- the photos: do matches between them agree with the poses (`MatchEvidence`)?
- the tracks: are the points where they were observed (`track_fit`)?

Each witness is first asked whether it can tell: points at random positions and photos without
matches say nothing. If a witness contradicts the cameras, the usual mistakes are tried (`repairs`).
The cameras are impossible only if another explanation fits what they do not fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.judge.colour_evidence import Agreement, ColourEvidence
from snowsplat.data.judge.finding import Finding
from snowsplat.data.judge.lens_check import lens_findings
from snowsplat.data.judge.mask_check import mask_findings
from snowsplat.data.judge.match_evidence import Fit, MatchEvidence
from snowsplat.data.judge.photo_sample import PhotoSample
from snowsplat.data.judge.repairs import Repair, point_repairs, pose_repairs, zooms
from snowsplat.data.judge.rig import Rig
from snowsplat.data.judge.track_evidence import TrackFit, track_fit
from snowsplat.scene.origin import HERE
from snowsplat.util.names import first_names
from snowsplat.util.natural_order import natural_key

# Colours: the share of views that agree. 0.15 by chance, 0.9 to 1 for right poses.
_COLOURS_AGREE = 0.6
_COLOURS_CONTRADICT = 0.35
# A correlation above this is none of chance. Photos that look alike may agree no less with others.
_COLOURS_FIT = 0.4
# Matches: pairs that are needed, and the share of matches that agree. 0 to 0.4 for wrong poses
# (0.4 if the cameras nearly look in one direction), 0.9 to 1 for exact ones.
_FEWEST_PAIRS = 3
_PAIRS_FOR_PROOF = 6
_MATCHES_AGREE = 0.5
_MATCHES_PROVE = 0.8
_MATCHES_CONTRADICT = 0.15
# A pair contradicts the poses if nearly none of its matches agree. Some pairs do in scenes that
# repeat themselves; poses that lost digits are wrong in about half of the pairs.
_PAIRS_CONTRADICT = 0.3
# A repair must improve the correlation of colours by this, or the share of matches by twice this.
_BETTER = 0.2
# Points that are projected to try a repair.
_POINTS_TO_TRY = 2000
# Another focal length must divide the distances of matches by this, in the median of the pairs.
_SHARPER = 2.0

# Distance of the scene from the origin, relative to the extent of the cameras. Kernels compute in
# float32, with a relative error of 6e-8. At a distance of 2000 extents this is a tenth of a pixel
# of a photo with 1000 pixels; at 50,000 it is some pixels.
_ROUNDED, _LOST = 2e3, 5e4


def judge(dataset: Dataset) -> list[Finding]:
    """What is impossible or doubtful about the cameras and masks of a dataset; empty if nothing is.

    Decodes up to 24 photos and 16 masks at a small size. Takes less than a second for most.
    """
    views = sorted([*dataset.train, *dataset.test], key=lambda view: natural_key(view.name))
    masks = mask_findings(views, dataset.points)
    rig = Rig.of([view.camera for view in views])
    lenses, positions = _lenses(views), _positions(rig)
    if any(finding.impossible for finding in lenses):
        return [*lenses, *masks]
    poses = _poses(views, rig, dataset.points, far=dataset.origin != HERE)
    # Wrong poses may have any positions; what is wrong with the poses says more.
    return [*lenses, *poses, *([] if poses else positions), *masks]


def _lenses(views: list[View]) -> list[Finding]:
    """The findings of each distinct lens, with the number of its views if there are others."""
    lenses = Counter(
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in views)
    )
    found: dict[tuple[str, bool], tuple[Finding, int]] = {}
    for lens, count in lenses.most_common():
        for finding in lens_findings(*lens):
            kind = finding.about, finding.impossible
            first, before = found.get(kind, (finding, 0))
            found[kind] = first, before + count
    return [
        Finding(
            finding.about,
            finding.text if count == len(views) else f"{count} photos: {finding.text}",
            finding.impossible,
        )
        for finding, count in found.values()
    ]


def _positions(rig: Rig) -> list[Finding]:
    """What is impossible or doubtful about the positions of cameras, whatever the scene is."""
    positions = rig.positions
    if len(positions) < 2:
        return []
    middle = positions.mean(0)
    extent = float(np.linalg.norm(positions - middle, axis=1).max())
    distance = float(np.linalg.norm(middle))
    # Positions are computed from rotations and translations, with rounding errors.
    if extent <= 1e-9 * max(distance, np.abs(rig.translation).max(), 1e-30):
        text = f"all {len(rig)} cameras are at one place, so the photos show no depth"
        return [Finding("positions", text)]
    if distance > _ROUNDED * extent:
        text = (
            f"the cameras are {distance:,.0f} units away from the origin, and {extent:.3g} from "
            f"each other, which 32-bit numbers cannot resolve; subtract "
            f"({', '.join(f'{value:.0f}' for value in middle)}) from the positions of cameras and "
            "points"
        )
        return [Finding("origin", text, impossible=distance > _LOST * extent)]
    return []


def _poses(views: list[View], rig: Rig, points: Points | None, *, far: bool) -> list[Finding]:
    sample = PhotoSample.of(views, rig)
    tracks = track_fit(views, rig, points)
    if len(sample) < 2:
        return [] if tracks is None else [tracks.finding(impossible=far)]
    rig = rig.select(sample.views)
    colours, agreement = None, None
    if points is not None:
        colours = ColourEvidence(sample, points.xyz.numpy(), points.rgb.numpy())
        agreement = colours.agreement(rig) if colours.informative() else None
    coloured = agreement is not None and _agrees(agreement, len(sample))
    matches = MatchEvidence(sample)
    fit = _fit(rig, matches)
    if not coloured and (fit is None or fit.share < _MATCHES_AGREE):
        matches.widen()
        fit = _fit(rig, matches)
    if coloured:
        found = []
    elif colours is None or agreement is None:
        found = [] if fit is None else _by_matches(rig, matches, fit)
    elif fit is None:
        found = _by_colours(rig, colours, agreement)
    elif fit.share >= _MATCHES_AGREE:
        found = _points(rig, colours, agreement)
    else:
        found = _by_both(rig, colours, agreement, matches, fit)
    if any(finding.impossible for finding in found) or (found and tracks is None):
        return found
    if fit is not None and (fit.shares < _MATCHES_CONTRADICT).any() and not matches.widened:
        matches.widen()
        fit = matches.fit(rig)
    if fit is not None and not far:
        for wrong, text in (
            (_lost(rig, matches, fit), "contradict their matches with all other photos"),
            (_frozen(rig, matches, fit), "are those of other photos, which show other places"),
        ):
            if wrong:
                photos = tuple(views[sample.views[i]].name for i in wrong)
                text = f"the poses of {first_names(photos, 5)} {text}; a training leaves them out"
                found = [*found, Finding("poses", text, photos=photos)]
        if any(finding.photos for finding in found):
            return found
    return _inexact(fit, tracks, far=far)


def _lost(rig: Rig, matches: MatchEvidence, fit: Fit) -> list[int]:
    """The views of the sample none of whose pairs agrees, if the pairs of the others do. Two views
    of one pose say nothing."""
    pairs = [
        ({pair.a, pair.b}, share)
        for pair, share in zip(matches.pairs, fit.shares, strict=True)
        if not np.array_equal(rig.translation[pair.a], rig.translation[pair.b])
    ]
    lost: set[int] = set()
    while True:
        pairs = [(both, share) for both, share in pairs if both.isdisjoint(lost)]
        shares: dict[int, list[float]] = {}
        for both, share in pairs:
            for view in both:
                shares.setdefault(view, []).append(share)
        contradicted = {
            view: float(np.median(each))
            for view, each in shares.items()
            if len(each) >= _FEWEST_PAIRS and max(each) < _MATCHES_AGREE
        }
        if not contradicted:
            break
        lost.add(min(contradicted, key=contradicted.__getitem__))
    rest = [share for _, share in pairs]
    proven = len(rest) >= _PAIRS_FOR_PROOF and np.median(rest) >= _MATCHES_PROVE
    return sorted(lost) if proven and 2 * len(lost) < len(rig) else []


def _frozen(rig: Rig, matches: MatchEvidence, fit: Fit) -> list[int]:
    """The views of the sample with the pose of another one that shows another place, and fits this
    pose better. Trackers that were lost repeat a pose."""
    same = [
        np.array_equal(rig.translation[pair.a], rig.translation[pair.b])
        and np.array_equal(rig.rotation[pair.a], rig.rotation[pair.b])
        for pair in matches.pairs
    ]
    distances: dict[int, list[float]] = {}
    for pair, equal, median in zip(matches.pairs, same, fit.medians, strict=True):
        for view in () if equal else (pair.a, pair.b):
            distances.setdefault(view, []).append(median)
    typical = {
        view: float(np.median(each))
        for view, each in distances.items()
        if len(each) >= _FEWEST_PAIRS
    }
    frozen = set()
    for pair, equal in zip(matches.pairs, same, strict=True):
        if equal and pair.moved >= _MATCHES_PROVE and {pair.a, pair.b} <= typical.keys():
            right, wrong = sorted((pair.a, pair.b), key=typical.__getitem__)
            if typical[wrong] >= _SHARPER * typical[right]:
                frozen.add(wrong)
    return sorted(frozen)


def _inexact(fit: Fit | None, tracks: TrackFit | None, *, far: bool) -> list[Finding]:
    """Poses of which some are right, or nearly right, so that no other witness has named them.

    ``far``: the scene was far from the origin, where numbers lose digits.
    """
    shares = np.ones(0) if fit is None else fit.shares
    wrong = int((shares < _MATCHES_CONTRADICT).sum())
    contradicted = wrong >= max(_FEWEST_PAIRS, _PAIRS_CONTRADICT * len(shares))
    if tracks is not None:
        return [tracks.finding(impossible=far or contradicted)]
    if not contradicted:
        return []
    text = f"the matches of {wrong} of {len(shares)} pairs of photos contradict the poses"
    if not far:
        return [Finding("poses", f"{text}, so the poses of some photos are wrong")]
    text += "; the poses were too far from the origin, and lost digits"
    todo = "move the scene to the origin in the program that made the poses, and export it again"
    return [Finding("poses", f"{text}; {todo}", impossible=True)]


def _fit(rig: Rig, matches: MatchEvidence) -> Fit | None:
    """None: too few photos match to say anything."""
    return matches.fit(rig) if len(matches.pairs) >= _FEWEST_PAIRS else None


def _agrees(agreement: Agreement, views: int) -> bool:
    return 2 * agreement.judged >= views and agreement.agreeing >= _COLOURS_AGREE


def _by_matches(rig: Rig, matches: MatchEvidence, fit: Fit) -> list[Finding]:
    """Without coloured points: only matches."""
    if fit.share >= _MATCHES_AGREE:
        return _focal(rig, matches, fit)
    if repairs := _explaining(rig, matches, fit):
        return [_mistake(repairs[0], _of_matches(fit))]
    proven = len(matches.pairs) >= _PAIRS_FOR_PROOF and fit.share < _MATCHES_CONTRADICT
    return [_disorder(_of_matches(fit), impossible=proven)]


def _by_colours(rig: Rig, colours: ColourEvidence, agreement: Agreement) -> list[Finding]:
    """Photos without matches: only the colours of the points."""
    candidates = [*pose_repairs(rig), *point_repairs(rig)]
    if repair := _best_by_colours(candidates, colours, agreement):
        return [_mistake(repair, _of_colours(agreement))]
    return [_disorder(_of_colours(agreement), impossible=False)]


def _points(rig: Rig, colours: ColourEvidence, agreement: Agreement) -> list[Finding]:
    """The poses fit the photos, but the points do not fit both."""
    if agreement.agreeing >= _COLOURS_AGREE:  # the points cover only a part of the views
        return []
    if repair := _best_by_colours(point_repairs(rig), colours, agreement):
        return [_mistake(repair, _of_colours(agreement))]
    if agreement.correlation >= _COLOURS_FIT:
        return []
    text = f"{_of_colours(agreement)}; the points may be in another frame than the poses"
    return [Finding("points", text)]


def _by_both(
    rig: Rig, colours: ColourEvidence, agreement: Agreement, matches: MatchEvidence, fit: Fit
) -> list[Finding]:
    """Neither the colours nor the matches fit the poses."""
    evidence = f"{_of_matches(fit)}, and {_of_colours(agreement)}"
    if repairs := _explaining(rig, matches, fit):
        return [_mistake(_best_by_colours(repairs, colours, agreement) or repairs[0], evidence)]
    proven = len(matches.pairs) >= _PAIRS_FOR_PROOF and agreement.agreeing < _COLOURS_CONTRADICT
    return [_disorder(evidence, impossible=proven)]


def _focal(rig: Rig, matches: MatchEvidence, fit: Fit) -> list[Finding]:
    """Matches may lie near their epipolar lines with any focal length, if all cameras look at one
    small object. But they are nearest with the right one."""
    best, best_fit = None, fit
    for repair in zooms(rig):
        if (tried := matches.fit(repair.rig)).median < best_fit.median:
            best, best_fit = repair, tried
    with np.errstate(invalid="ignore"):  # infinite: behind a camera
        ratios = fit.medians / best_fit.medians
    clear = np.median(ratios) >= _SHARPER and np.mean(ratios > 1) >= _MATCHES_PROVE
    if best is None or not clear or best_fit.share < _MATCHES_PROVE:
        return []
    return [Finding("focal length", f"{best.mistake}, as the matches between the photos say")]


def _explaining(rig: Rig, matches: MatchEvidence, fit: Fit) -> list[Repair]:
    """The repairs that make the matches agree, the best one first."""
    found = []
    for repair in pose_repairs(rig):
        tried = matches.fit(repair.rig)
        if tried.share >= max(_MATCHES_PROVE, fit.share + 2 * _BETTER):
            found.append((tried.median, repair))
    best = min((median for median, _ in found), default=0.0)
    # Several names for one mistake fit equally, up to rounding: the usual one stands first.
    found = [(0.0 if median < 1.05 * best else median, repair) for median, repair in found]
    return [repair for _, repair in sorted(found, key=lambda pair: pair[0])]


def _best_by_colours(
    repairs: Iterable[Repair], colours: ColourEvidence, agreement: Agreement
) -> Repair | None:
    """The repair with which the colours agree best; None if they do with none of them."""
    best, best_value = None, max(agreement.correlation, 0.0) + _BETTER
    for repair in repairs:
        value = colours.correlation(repair.rig, repair.points, _POINTS_TO_TRY)
        if value > best_value:
            best, best_value = repair, value
    if best is None:
        return None
    confirmed = _agrees(colours.agreement(best.rig, best.points), len(best.rig))
    return best if confirmed else None


def _of_matches(fit: Fit) -> str:
    return f"only {np.mean(fit.shares):.0%} of the matches between photos agree with the poses"


def _of_colours(agreement: Agreement) -> str:
    if agreement.judged == 0:
        return "the points are not in front of the cameras"
    return (
        f"the points have other colours than the photos where the cameras see them (correlation "
        f"{agreement.correlation:.2f})"
    )


def _mistake(repair: Repair, evidence: str) -> Finding:
    return Finding(
        repair.about, f"{evidence}; {repair.mistake}; correct the dataset", impossible=True
    )


def _disorder(evidence: str, *, impossible: bool) -> Finding:
    text = (
        f"{evidence}; the poses may belong to other photos, or their axes or focal lengths are "
        "wrong"
    )
    return Finding("poses", f"{text}; export them again" if impossible else text, impossible)
