"""`MatchEvidence`: how probable poses make the matches between the photos, in nats.

A pair of photos is verified if enough of its matches agree with one epipolar geometry, whichever it
is. Its evidence is Σ log(ε + (1 − ε) r(d)) over its matches (`snowsplat.scene.epipolar`): positive
if the matches are where the poses say, and negative if they are anywhere. The matches of a pair are
not independent: a verified pair may be false as a whole (two places that look alike), and it may
agree with wrong poses by chance. The evidence of a pair is bounded by the odds of the two.

Single views with wrong poses are found by the typical distance of each pair instead: that of two
neighbours with exchanged poses is only a few pixels, but several times that of the other pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import cv2
import numpy as np

from snowsplat.data.dataset import View
from snowsplat.data.judge.rig import Rig
from snowsplat.data.photos.decode import load_thumbnail
from snowsplat.data.photos.image_loader import each_photo
from snowsplat.scene.epipolar import (
    LEAST_FALSE,
    LEAST_NOISE,
    distances_of_matches,
    likelihood,
    log_odds,
    sampson_distances,
)
from snowsplat.util.errors import UserError

_SIDE = 320  # pixels of the longer side of the copies of photos
_MOST_VIEWS = 256  # that are looked at, spread over larger datasets
_SPREAD = 24  # views of which all pairs are matched
_AROUND = 3  # views before and after each in the order of names, and nearest ones by pose
_FEATURES = 500  # of each photo
_RATIO = 0.8  # of the distances to the best and the second best feature, as in Lowe's paper
# A pair is verified if more matches agree than this and a share of all (Brown and Lowe 2007).
_FEWEST_MATCHES, _OF_MATCHES = 8, 0.3
_RANSAC_PIXELS = 1.5
# Relative to the longer side. What stays at its place is fixed to the frame (a time stamp) or to
# a tripod, and says nothing about the poses. σ is no larger: such poses are of no use.
_MOVED = _MOST_NOISE = 0.01
# Probabilities that a verified pair contradicts right poses, and that it agrees with wrong ones. Of
# 1,044 pairs of six captures 0.2% did; with shuffled poses, 2 to 17% (docs/cameras.md).
_FALSE, _BY_CHANCE = 0.01, 0.05
_LEAST_NATS = math.log(_FALSE / (1 - _BY_CHANCE))
_MOST_NATS = math.log((1 - _FALSE) / _BY_CHANCE)
# The share of frames with wrong poses that is expected, and the odds at which one is told.
_WRONG, _CERTAIN = 0.01, 10.0
# The typical distances of pairs with right poses differ by about this factor (one standard
# deviation): of 410 pairs of four captures, 95% are at most twice the median, and 99% thrice.
_FACTOR = 2.0
_PIXELS = 1600.0  # of the longer side, for `likelihood`


@dataclass(frozen=True)
class SmallPhoto:
    """What is kept of a photo.

    Attributes:
        view: its index in the dataset.
        size: width and height of its small copy, in pixels.
        features: see `_features`.
        copy: (4, h, w) uint8 RGBA, of a few photos: those of all would take more memory than their
            features. Masks are not applied: what is moving in a few photos misleads no witness, and
            a mask may be wrong.
    """

    view: int
    size: tuple[int, int]
    features: tuple[np.ndarray, np.ndarray]
    copy: np.ndarray | None


@dataclass(frozen=True)
class PhotoSample:
    """Photos of a dataset, in the order of its views."""

    photos: list[SmallPhoto]

    @classmethod
    def of(cls, views: Sequence[View]) -> PhotoSample:
        """Decode photos: pairs of neighbours, if there are many. Those that are damaged are not
        used."""
        chosen = np.arange(len(views))
        if len(views) > _MOST_VIEWS:
            first = np.linspace(0, len(views) - 2, _MOST_VIEWS // 2).round().astype(int)
            chosen = np.unique([first, first + 1])
        every = np.linspace(0, len(chosen) - 1, min(len(chosen), _SPREAD)).round().astype(int)
        spread = set(chosen[every].tolist())

        def look_at(view: int) -> SmallPhoto | None:
            try:
                copy = load_thumbnail(views[view].image, _SIDE)
            except UserError:  # the training says so, or leaves the photo out
                return None
            size = copy.shape[2], copy.shape[1]
            return SmallPhoto(view, size, _features(copy), copy if view in spread else None)

        return cls([each for each in each_photo(look_at, chosen.tolist()) if each is not None])

    def __len__(self) -> int:
        return len(self.photos)

    @property
    def views(self) -> list[int]:
        """Their indices in the dataset."""
        return [photo.view for photo in self.photos]

    @cached_property
    def spread(self) -> list[int]:
        """The photos with a copy, by their index in the sample; spread over it."""
        return [i for i, photo in enumerate(self.photos) if photo.copy is not None]


@dataclass(frozen=True)
class Pair:
    """Two views of the sample, and matches (N, 2) relative to the sizes of their photos.

    ``own``: the median distance of the matches from the lines of the epipolar geometry with which
    they agree best, relative to the longer side.
    """

    a: int
    b: int
    in_a: np.ndarray
    in_b: np.ndarray
    own: float


@dataclass(frozen=True)
class Fit:
    """How well cameras explain the matches of each pair.

    Attributes:
        a, b: (pairs,) the views of each.
        nats: (pairs,) the evidence for the poses, unbounded.
        contrast: (pairs,) nats; how much more probable the typical distance of the pair is if both
            poses are right, as most are, than if one of them is wrong; bounded.
        noise: σ, the distance of the matches from their epipolar lines, relative to the longer
            side.
    """

    a: np.ndarray
    b: np.ndarray
    nats: np.ndarray
    contrast: np.ndarray
    noise: float

    def odds(self, other: Fit | None = None) -> float:
        """In nats: how much more probable these cameras are than others; None: than those that say
        nothing."""
        return float(_bounded(self.nats if other is None else self.nats - other.nats).sum())

    @property
    def agreeing(self) -> float:
        """The share of the pairs whose matches agree with the poses."""
        return float(np.mean(self.nats > 0))

    def doubtful(self, count: int) -> list[int]:
        """The views, of ``count``, that have no pair, or less evidence for than against them."""
        nats = self.contrast
        evidence = np.bincount(self.a, nats, count) + np.bincount(self.b, nats, count)
        return [int(i) for i in np.flatnonzero(evidence <= 0)]

    def wrong(self, count: int) -> list[int]:
        """The views, of ``count``, whose poses are wrong if those of the others are right.

        The set of wrong views is the most probable one, as far as a greedy search finds it: pairs
        of right ones have their evidence, other pairs have none, and each wrong view costs the
        logarithm of its prior odds. A view that agrees with no right one tells nothing about
        others: it may be wrong itself.
        """
        cost = math.log((1 - _WRONG) / _WRONG * _CERTAIN)
        nats = self.contrast
        right = np.ones(count, bool)
        ends = (self.a, self.b), (self.b, self.a)
        for _ in range(2 * count):
            agree = (nats > 0) & right[self.a] & right[self.b]
            confirmed = np.zeros(count, bool)
            confirmed[self.a[agree]] = confirmed[self.b[agree]] = True
            evidence = np.zeros(count)
            for own, other in ends:
                tells = right[other] & ((nats > 0) | confirmed[other])
                evidence += np.bincount(own, nats * tells, count)
            gain = np.where(right, -1.0, 1.0) * (evidence + cost)
            best = int(gain.argmax())
            if gain[best] <= 0:
                break
            right[best] = not right[best]
        return [int(i) for i in np.flatnonzero(~right)]


class MatchEvidence:
    """Matches between the photos of a sample that agree with a rigid scene, without its poses.

    Pairs are made of views that follow each other and of those that are close by pose; of all, if
    there are few.
    """

    def __init__(self, sample: PhotoSample, rig: Rig) -> None:
        self._sample = sample
        self._tried: set[tuple[int, int]] = set()
        self.pairs: list[Pair] = []
        count = len(sample)
        if count <= _SPREAD:
            self._add(combinations(range(count), 2))
        else:
            self._add((i, i + step) for step in range(1, _AROUND + 1) for i in range(count - step))
            self._add(_near_by_pose(rig))

    def widen(self, views: Iterable[int]) -> None:
        """Add the pairs of these views with others, wherever they are said to be."""
        self._add((view, other) for view in views for other in self._sample.spread)

    def fit(self, rig: Rig, pairs: Sequence[Pair] | None = None) -> Fit:
        """How well cameras of the views of the sample explain the matches of (all) pairs."""
        pairs = self.pairs if pairs is None else pairs
        parts = [_distances(pair, rig) for pair in pairs]
        distances = _PIXELS * np.concatenate([*parts, np.empty(0)])
        sides = np.full(len(distances), _PIXELS)
        noise = 0.0
        nats = contrast = np.empty(0)
        a, b = (np.array([pair[k] for pair in ((p.a, p.b) for p in pairs)], int) for k in (0, 1))
        if pairs:
            noise = min(likelihood(distances, sides)[1], _MOST_NOISE * _PIXELS)
            each = log_odds(distances, sides, noise, LEAST_FALSE)
            nats = np.add.reduceat(each, np.cumsum([0, *map(len, parts[:-1])]))
            typical = np.array([min(np.median(part), 0.5) for part in parts])
            contrast = _contrast(a, b, typical, np.array([pair.own for pair in pairs]))
        return Fit(a, b, nats, contrast, noise / _PIXELS)

    @cached_property
    def spread(self) -> list[Pair]:
        """A few of the pairs: for each of the spread views, that with the most matches."""
        chosen = {}
        for view in self._sample.spread:
            own = [pair for pair in self.pairs if view in (pair.a, pair.b)]
            if own:
                best = max(own, key=lambda pair: len(pair.in_a))
                chosen[best.a, best.b] = best
        return list(chosen.values())

    def without(self, views: Iterable[int], pairs: Sequence[Pair] | None = None) -> list[Pair]:
        """Those of (all) ``pairs`` in which none of ``views`` is."""
        left_out = set(views)
        pairs = self.pairs if pairs is None else pairs
        return [pair for pair in pairs if left_out.isdisjoint((pair.a, pair.b))]

    def _add(self, candidates: Iterable[tuple[int, int]]) -> None:
        new = {(min(both), max(both)) for both in candidates if both[0] != both[1]} - self._tried
        self._tried |= new
        self.__dict__.pop("spread", None)
        matched = each_photo(lambda both: self._verified(*both), sorted(new))
        self.pairs += [pair for pair in matched if pair is not None]

    def _verified(self, a: int, b: int) -> Pair | None:
        one, two = self._sample.photos[a], self._sample.photos[b]
        found = _pair_matches(one.features, two.features, (one.size, two.size))
        return None if found is None else Pair(a, b, *found)


def _bounded(nats: np.ndarray) -> np.ndarray:
    return nats.clip(_LEAST_NATS, _MOST_NATS)


def _contrast(a: np.ndarray, b: np.ndarray, typical: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(pairs,) `Fit.contrast`, of the ``typical`` distances (pairs,) of pairs of the views ``a``
    and ``b`` (pairs,), at most 0.5. A pair of blurred photos has large ones in any geometry
    (``own``).

    The logarithm of the distance is normal above what is usual, or it is any up to that of half the
    photo. Usual is the median over the views of the median of their pairs, because wrong views may
    have many pairs. If all poses are inexact, and thus more than the matches, the distances differ
    more, too.
    """
    of_views = [np.median(typical[(a == i) | (b == i)]) for i in {*a, *b}]
    usual = float(np.clip(np.median(of_views), LEAST_NOISE / _PIXELS, _MOST_NOISE))
    deviation = math.log(max(_FACTOR, usual / max(np.median(own), LEAST_NOISE / _PIXELS)))
    away = np.log(np.maximum(typical / np.maximum(own, usual), 1.0)) / deviation
    density = math.log(math.log(0.5 / usual) / (deviation * math.sqrt(2 * math.pi)))
    return _bounded(density - 0.5 * away**2)


def _near_by_pose(rig: Rig) -> Iterable[tuple[int, int]]:
    """Each view with those that are nearest in position and viewing direction."""
    positions = rig.positions - rig.positions.mean(0)
    spread = max(float(np.linalg.norm(positions, axis=1).max()), 1e-30)
    where = np.hstack([positions / spread, rig.rotation[:, 2]])
    for i, own in enumerate(where):
        distance = np.linalg.norm(where - own, axis=1)
        distance[i] = np.inf
        yield from ((i, int(j)) for j in np.argsort(distance, kind="stable")[:_AROUND])


def _features(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) relative to the size of the photo, and descriptors (N, 128) uint8."""
    height, width = photo.shape[1:]
    grey = cv2.cvtColor(np.ascontiguousarray(photo[:3].transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    grey = np.where(photo[3] >= 128, grey, 0).astype(np.uint8)
    mask = np.where(photo[3] >= 128, 255, 0).astype(np.uint8)
    found, descriptors = cv2.SIFT_create(_FEATURES).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.uint8)
    where = (np.array([point.pt for point in found]) + 0.5) / [width, height]
    return where, descriptors.astype(np.uint8)  # OpenCV rounds them to 0 to 255


def _unit(descriptors: np.ndarray) -> np.ndarray:
    """Unit vectors: roots compare histograms better (Arandjelović and Zisserman 2012)."""
    values = descriptors.astype(np.float32)
    return np.sqrt(values / np.maximum(values.sum(1, keepdims=True), 1e-9))


def _pair_matches(
    a: tuple[np.ndarray, np.ndarray],
    b: tuple[np.ndarray, np.ndarray],
    sizes: Sequence[Sequence[int]],
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """The positions (N, 2) in both photos of features that are each other's best match, that move,
    and that agree with one epipolar geometry, and their `Pair.own`; None: too few."""
    if min(len(a[0]), len(b[0])) < _FEWEST_MATCHES:
        return None
    similar = _unit(a[1]) @ _unit(b[1]).T
    best = similar.argmax(1)
    rows = np.arange(len(best))
    mutual = similar.argmax(0)[best] == rows
    first = similar[rows, best]
    similar[rows, best] = -1.0
    distinct = 2 - 2 * first < _RATIO**2 * (2 - 2 * similar.max(1))
    in_a, in_b = a[0], b[0][best]
    kept = mutual & distinct & (np.abs(in_a - in_b).max(1) > _MOVED)
    if kept.sum() < _FEWEST_MATCHES:
        return None
    in_a, in_b = in_a[kept], in_b[kept]
    cv2.setRNGSeed(0)
    pixels = in_a * sizes[0], in_b * sizes[1]
    matrix, mask = cv2.findFundamentalMat(*pixels, cv2.FM_RANSAC, _RANSAC_PIXELS, 0.99, 500)
    agree = np.zeros(len(in_a), bool) if mask is None else mask[:, 0] > 0
    if agree.sum() <= _FEWEST_MATCHES + _OF_MATCHES * len(agree):
        return None
    own = np.median(sampson_distances(matrix, *(each[agree] for each in pixels)))
    return in_a[agree], in_b[agree], float(own) / max(*sizes[0], *sizes[1])


def _distances(pair: Pair, rig: Rig) -> np.ndarray:
    """(N,) distances of the matches from their epipolar lines, relative to the longer side of the
    photos; infinite for points behind a camera. If both cameras are at one place, the distances
    from the points that their rotation says."""
    one, two = rig.rays(pair.a, pair.in_a), rig.rays(pair.b, pair.in_b)
    rotation = rig.rotation[pair.b] @ rig.rotation[pair.a].T
    baseline = rig.translation[pair.b] - rotation @ rig.translation[pair.a]
    if np.linalg.norm(baseline) <= 1e-9 * np.linalg.norm(rig.translation[pair.b]):
        turned = np.column_stack([one, np.ones(len(one))]) @ rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.linalg.norm(turned[:, :2] / turned[:, 2:] - two, axis=1)
        distance = np.where(turned[:, 2] > 0, distance, np.inf)
    else:
        distance = distances_of_matches(rotation, baseline, one, two)
    return np.mean([rig.focal[i] * rig.aspect[i] for i in (pair.a, pair.b)]) * distance
