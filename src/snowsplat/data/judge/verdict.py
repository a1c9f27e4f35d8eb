"""`judge`: are the cameras and masks of a dataset possible? Asked before every training.

Four witnesses are heard, as far as the dataset has them:

- the numbers: lenses, positions (`lens_check`);
- the photos: how probable do the poses make the matches between them (`MatchEvidence`)?
- the points: have they the colours of the photos where the cameras see them (`ColourEvidence`)?
- the tracks: are the points where they were observed (`tracks_off`)? For a model as it was written,
  the typical distance to the projected point is below 2 pixels. It is more if poses, points or
  intrinsics were changed later, or lost digits; and if the photos were scaled, cropped or
  undistorted later: then the matches of the photos agree with the poses.

The evidence is in nats: the logarithm of how much more probable the photos are with the given
cameras than with cameras that say nothing. Photos without matches and points at random positions
add nothing. Each frame is judged by its own matches, and the usual mistakes (`repairs`) are
compared with the given cameras in the same unit. The cameras are impossible only if the odds are
overwhelming.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.judge.colour_evidence import Agreement, ColourEvidence
from snowsplat.data.judge.lens_check import Finding, lens_findings
from snowsplat.data.judge.mask_check import mask_findings
from snowsplat.data.judge.match_evidence import Fit, MatchEvidence, PhotoSample
from snowsplat.data.judge.repairs import Repair, point_repairs, pose_repairs
from snowsplat.data.judge.rig import Rig
from snowsplat.scene.origin import HERE
from snowsplat.util.messages import Message, message
from snowsplat.util.names import first_names
from snowsplat.util.natural_order import natural_key

# Distance relative to the longer side of the photo: 10 pixels of 1000. Programs discard
# observations that are more than 4 to 16 pixels away; the typical distance is far less.
_OFF = 0.01
_FEWEST = 10  # observations that a photo needs to be judged


def tracks_off(views: Sequence[View], rig: Rig, points: Points | None) -> tuple[int, list[float]]:
    """The number of photos with enough observations; and the typical distances of points in those
    where it is more than 1% of the longer side, relative to it: infinite if most points are behind
    the camera.

    Args:
        views: the views of the dataset.
        rig: their cameras.
        points: with or without tracks.
    """
    tracks = None if points is None else points.tracks
    if points is None or tracks is None:
        return 0, []
    number = {view.name: i for i, view in enumerate(views)}
    xyz = points.xyz.numpy().astype(np.float64)[tracks.point]
    count, off = 0, []
    for photo, name in enumerate(tracks.photos):
        chosen = np.flatnonzero(tracks.photo == photo)
        if (view := number.get(name)) is None or len(chosen) < _FEWEST:
            continue
        where, depth = rig.project(view, xyz[chosen])
        rest = where - rig.centre[view] - tracks.ray[chosen] * rig.focal[view]
        distance = np.linalg.norm(rest * rig.aspect[view], axis=1)
        typical = float(np.median(np.where(depth > 0, distance, np.inf)))
        count += 1
        if not typical <= _OFF:
            off.append(typical)
    return count, off


# Nats. Odds of 10^4 are told; odds of 10^8 are overwhelming.
_TOLD, _OVERWHELMING = math.log(1e4), math.log(1e8)
# Wrong poses of at most this share of the frames are those of single frames.
_MINORITY = 1 / 3
# Typical distance of matches from where the poses say, relative to the longer side: 5 pixels of
# 1000 are visible in a training. Poses by structure from motion have 0.0008 to 0.0013.
_INEXACT = 0.005
# Nats for each match by which two repairs differ that are the same mistake, apart from rounding.
_EQUAL = 0.05
# A correlation of colours above this is none of chance; a change of the points improves it by this.
_COLOURS_FIT, _BETTER = 0.4, 0.2
# Points that are projected to try a repair.
_POINTS_TO_TRY = 2000

# Distance of the scene from the origin, relative to the extent of the cameras. Kernels compute in
# float32, with a relative error of 6e-8. At a distance of 2000 extents this is a tenth of a pixel
# of a photo with 1000 pixels; at 50,000 it is some pixels.
_ROUNDED, _LOST = 2e3, 5e4


def judge(dataset: Dataset) -> list[Finding]:
    """What is impossible or doubtful about the cameras and masks of a dataset; empty if nothing is.

    Decodes up to 256 photos and 16 masks at a small size: about 50 ms of one core for each photo.
    """
    views = sorted([*dataset.train, *dataset.test], key=lambda view: natural_key(view.name))
    masks = mask_findings(views, dataset.points)
    rig = Rig.of([view.camera for view in views])
    lenses, positions = _lenses(views), _positions(rig)
    if any(finding.impossible for finding in lenses):
        return [*lenses, *masks]
    evidence = _Evidence.of(views, rig, dataset.points, far=dataset.origin != HERE)
    poses = _poses(evidence)
    if not poses and max(evidence.odds, evidence.seen) <= _TOLD:
        # Only the tracks say anything.
        count, off = tracks_off(views, rig, dataset.points)
        poses = [_tracks(count, off, far=evidence.far)] if len(off) > _MINORITY * count else []
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
            finding.text
            if count == len(views)
            else message("{count} photos: {text}", count=count, text=finding.text),
            finding.advice,
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
        text = message(
            "all {count} cameras are at one place, so the photos show no depth", count=len(rig)
        )
        return [Finding("positions", text)]
    if distance > _ROUNDED * extent:
        text = message(
            "the cameras are {distance:,.0f} units away from the origin, and {extent:.3g} from "
            "each other, which 32-bit numbers cannot resolve",
            distance=distance,
            extent=extent,
        )
        advice = message(
            "subtract ({middle}) from the positions of cameras and points",
            middle=", ".join(f"{value:.0f}" for value in middle),
        )
        return [Finding("origin", text, advice, impossible=distance > _LOST * extent)]
    return []


@dataclass(frozen=True)
class _Evidence:
    """What the witnesses say about some views of a dataset.

    Attributes:
        names: of the views.
        rig: their cameras.
        spread: some of the views, by their indices, whose colours are compared.
        matches, fit: of all pairs, or of those of the right views, if most are right.
        wrong: the views whose own matches contradict their poses.
        odds: nats, the evidence of a few pairs that are spread over the dataset.
        colours, agreement: of the spread views; None if points say nothing.
        far: the scene was far from the origin, where numbers lose digits.
    """

    names: list[str]
    rig: Rig
    spread: list[int]
    matches: MatchEvidence
    fit: Fit
    wrong: list[int]
    odds: float
    colours: ColourEvidence | None
    agreement: Agreement | None
    far: bool

    @classmethod
    def of(cls, views: list[View], rig: Rig, points: Points | None, *, far: bool) -> _Evidence:
        sample = PhotoSample.of(views)
        rig = rig.select(sample.views)
        matches = MatchEvidence(sample, rig)
        fit = matches.fit(rig)
        if doubtful := fit.doubtful(len(sample)):
            few = len(doubtful) <= _MINORITY * len(sample)
            matches.widen(doubtful if few else sample.spread)
            fit = matches.fit(rig)
        colours, agreement = None, None
        if points is not None and len(sample) > 1:
            photos = [photo.copy for photo in sample.photos if photo.copy is not None]
            colours = ColourEvidence(photos, points.xyz.numpy(), points.rgb.numpy())
            agreement = (
                colours.agreement(rig.select(sample.spread)) if colours.informative() else None
            )
        odds = matches.fit(rig, matches.spread).odds()
        names = [views[i].name for i in sample.views]
        wrong = fit.wrong(len(sample))
        if wrong and len(wrong) <= _MINORITY * len(sample):
            fit = matches.fit(rig, matches.without(wrong))
        return cls(names, rig, sample.spread, matches, fit, wrong, odds, colours, agreement, far)

    @property
    def minority(self) -> bool:
        """Whether the wrong poses are those of single frames."""
        return len(self.wrong) <= _MINORITY * len(self.names)

    @property
    def seen(self) -> float:
        """The evidence of the colours."""
        if self.agreement is None:
            return 0.0
        return self.agreement.odds if self.matches.pairs else self.agreement.odds_of_all

    def repaired(self) -> list[Repair]:
        """The repairs of poses and lenses that make the matches more probable, by odds that are
        told; the most probable ones, which are equal."""
        # Single frames with wrong poses are no mistake of all.
        wrong = self.wrong if self.minority else []
        pairs = self.matches.without(wrong, self.matches.spread)
        given = self.matches.fit(self.rig, pairs)
        found = []
        for repair in pose_repairs(self.rig):
            fit = self.matches.fit(repair.rig, pairs)
            if fit.odds(given) > _TOLD and fit.odds() > _TOLD:
                found.append((float(fit.nats.sum()), repair))
        best = max((nats for nats, _ in found), default=0.0)
        equal = _EQUAL * sum(len(pair.in_a) for pair in pairs)
        return [repair for nats, repair in found if nats >= best - equal]

    def best_by_colours(self, repairs: Iterable[Repair]) -> Repair | None:
        """The repair with which the colours agree best; None if they do with none of them."""
        if self.colours is None or self.agreement is None:
            return None
        best, best_value = None, max(self.agreement.correlation, 0.0) + _BETTER
        for repair in repairs:
            rig = repair.rig.select(self.spread)
            value = self.colours.correlation(rig, repair.points, _POINTS_TO_TRY)
            if value > best_value:
                best, best_value = repair, value
        if best is None:
            return None
        agreement = self.colours.agreement(best.rig.select(self.spread), best.points)
        return best if agreement.odds - self.agreement.odds > _TOLD else None


def _poses(evidence: _Evidence) -> list[Finding]:
    """What the matches and colours say about the poses, and about the frame of the points."""
    because = Message("")
    if evidence.fit.nats.size:
        because = message(
            "the matches of {share:.0%} of the pairs of photos agree with the poses, typically "
            "{noise:.2%} of their size away from where the poses say",
            share=evidence.fit.agreeing,
            noise=evidence.fit.noise,
        )
    if evidence.agreement is not None and evidence.seen < 0:
        colours = _of_colours(evidence.agreement)
        because = message("{one}, and {other}", one=because, other=colours) if because else colours
    is_exact = evidence.fit.noise <= _INEXACT
    matched = evidence.odds > 0 and is_exact
    if repairs := evidence.repaired():
        best = evidence.best_by_colours(repairs) or repairs[0]
        return [_mistake(best, because, impossible=not matched)]
    if evidence.seen < _TOLD and (matched or not evidence.matches.pairs):
        poses = () if matched else pose_repairs(evidence.rig)
        if repair := evidence.best_by_colours([*poses, *point_repairs(evidence.rig)]):
            return [_mistake(repair, because, impossible=True)]
    disorder = not matched and evidence.odds + evidence.seen < -_TOLD
    if evidence.far and (disorder or not is_exact or not evidence.minority):
        text = message(
            "{because}; the poses were too far from the origin, and lost digits", because=because
        )
        advice = message(
            "move the scene to the origin in the program that made the poses, and export it again"
        )
        return [Finding("poses", text, advice, impossible=True)]
    if disorder:
        return [_disorder(because, impossible=evidence.odds < -_OVERWHELMING)]
    if not is_exact:
        text = message(
            "{because}; the poses are inexact, or belong to other photos", because=because
        )
        return [Finding("poses", text)]
    found = [_frames(evidence)] if evidence.wrong else []
    agreement = evidence.agreement
    if agreement is not None and evidence.seen < -_TOLD and agreement.correlation < _COLOURS_FIT:
        text = message(
            "{because}; the points may be in another frame than the poses",
            because=_of_colours(agreement),
        )
        found.append(Finding("points", text))
    return found


def _frames(evidence: _Evidence) -> Finding:
    """Photos whose own matches contradict their poses."""
    photos = tuple(evidence.names[i] for i in evidence.wrong)
    text = message(
        "the poses of {photos} contradict their matches with other photos",
        photos=first_names(photos, 5),
    )
    if evidence.minority:
        return Finding("poses", text, message("a training leaves them out"), photos=photos)
    return Finding("poses", text, message("estimate the poses again"))


def _tracks(count: int, off: Sequence[float], *, far: bool) -> Finding:
    """Photos in which the points are not where they were observed."""
    distance = float(np.median(off))
    place = message("behind the camera")
    if np.isfinite(distance):
        place = message(
            "{distance:.1%} of the size of the photo away from where it was observed",
            distance=distance,
        )
    text = message(
        "poses and points do not fit each other: in {off} of {count} photos, a typical point is "
        "{place}; they were changed, or lost digits, after the reconstruction",
        off=len(off),
        count=count,
        place=place,
    )
    advice = message("export both again, in one frame near the origin")
    return Finding("poses", text, advice, impossible=far)


def _of_colours(agreement: Agreement) -> Message:
    if agreement.judged == 0:
        return message("the points are not in front of the cameras")
    return message(
        "the points have other colours than the photos where the cameras see them (correlation "
        "{correlation:.2f})",
        correlation=agreement.correlation,
    )


def _mistake(repair: Repair, evidence: Message, *, impossible: bool) -> Finding:
    text = message("{evidence}; {mistake}", evidence=evidence, mistake=repair.mistake)
    return Finding(repair.about, text, message("correct the dataset"), impossible)


def _disorder(evidence: Message, *, impossible: bool) -> Finding:
    text = message(
        "{evidence}; the poses may belong to other photos, or their axes or focal lengths are "
        "wrong",
        evidence=evidence,
    )
    advice = message("export them again") if impossible else None
    return Finding("poses", text, advice, impossible)
