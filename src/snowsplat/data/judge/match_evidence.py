"""`MatchEvidence`: do the same things in two photos lie where both cameras can see one point?"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from snowsplat.data.judge.photo_sample import PhotoSample
from snowsplat.data.judge.rig import Rig

_FEATURES = 500  # of each photo
_RATIO = 0.8  # of the distances to the best and the second best feature, as in Lowe's paper
# Matches of a pair that agree with one epipolar geometry, whichever it is. Seven matches define
# one, so a few more agree by chance.
_FEWEST_MATCHES = 25
_MOST_PAIRS = 24
# Relative to the longer side. What stays at its place is fixed to the frame (a time stamp) or to
# a tripod, and says nothing about the poses.
_MOVED = 0.01
_RANSAC_PIXELS = 1.5
# Distance from the epipolar line, relative to the longer side.
_NEAR = 0.01
# Radians between two rays. Depths of points with less parallax are noise.
_PARALLAX = 0.01


@dataclass(frozen=True)
class Pair:
    """Two views of the sample, and matches (N, 2) relative to the sizes of their photos.

    ``moved``: the share of all their matches that are not at the same place in both photos.
    """

    a: int
    b: int
    in_a: np.ndarray
    in_b: np.ndarray
    moved: float = 1.0


@dataclass(frozen=True)
class Fit:
    """How well cameras explain the matches of each pair.

    Attributes:
        shares: (pairs,) the share of the matches that both cameras see as one point in front of
            them, within 1% of the size of the photo.
        medians: (pairs,) the median distance of the matches from their epipolar lines, relative to
            the longer side; infinite if most of them are behind a camera.
    """

    shares: np.ndarray
    medians: np.ndarray

    @property
    def share(self) -> float:
        """The median over the pairs."""
        return float(np.median(self.shares))

    @property
    def median(self) -> float:
        """The median over the pairs."""
        return float(np.median(self.medians))


class MatchEvidence:
    """Matches between the photos of a sample that agree with a rigid scene, without its poses."""

    def __init__(self, sample: PhotoSample) -> None:
        self._sample = sample
        self.widened = False
        self._features = [_features(photo) for photo in sample.photos]
        #: The pairs with enough matches, within the groups of the sample.
        self.pairs = self._match_pairs(same_group=True)

    def widen(self) -> None:
        """Add pairs of different groups. If the names are shuffled, views of one group do not see
        the same things, but others do.
        """
        self.widened = True
        self.pairs += self._match_pairs(same_group=False)

    def _match_pairs(self, *, same_group: bool) -> list[Pair]:
        groups, near = self._sample.groups, self._sample.near
        candidates = [
            Pair(a, b, *_matches(self._features[a], self._features[b]))
            for a, b in combinations(range(len(groups)), 2)
            if (groups[a] == groups[b] or (a, b) in near) == same_group
        ]
        candidates.sort(key=lambda pair: -len(pair.in_a))
        chosen = candidates[:_MOST_PAIRS]
        chosen += [pair for pair in candidates[_MOST_PAIRS:] if (pair.a, pair.b) in near]
        rigid = (_rigid(pair, self._sample) for pair in chosen)
        return [pair for pair in rigid if len(pair.in_a) >= _FEWEST_MATCHES]

    def fit(self, rig: Rig) -> Fit:
        """How well cameras of the views of the sample explain the matches; see `Fit`."""
        distances = [_distances(pair, rig) for pair in self.pairs]
        return Fit(
            np.array([np.mean(d < _NEAR) for d in distances]),
            np.array([np.median(d) for d in distances]),
        )


def _features(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) relative to the size of the photo, and unit descriptors (N, 128)."""
    height, width = photo.shape[1:]
    grey = cv2.cvtColor(np.ascontiguousarray(photo[:3].transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    grey = np.where(photo[3] >= 128, grey, 0).astype(np.uint8)
    mask = np.where(photo[3] >= 128, 255, 0).astype(np.uint8)
    found, descriptors = cv2.SIFT_create(_FEATURES).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    where = (np.array([point.pt for point in found]) + 0.5) / [width, height]
    # The root of SIFT compares histograms better (Arandjelović and Zisserman 2012).
    return where, np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))


def _matches(
    a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The positions (N, 2) in both photos of features that are each other's best match."""
    if min(len(a[0]), len(b[0])) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    similar = a[1] @ b[1].T
    best = similar.argmax(1)
    rows = np.arange(len(best))
    mutual = similar.argmax(0)[best] == rows
    first = similar[rows, best]
    similar[rows, best] = -1.0
    second = similar.max(1)
    distinct = 2 - 2 * first < _RATIO**2 * (2 - 2 * second)
    kept = mutual & distinct
    return a[0][kept], b[0][best[kept]]


def _rigid(pair: Pair, sample: PhotoSample) -> Pair:
    """The matches that move and that agree with one epipolar geometry."""
    moved = np.abs(pair.in_a - pair.in_b).max(1) > _MOVED
    in_a, in_b = pair.in_a[moved], pair.in_b[moved]
    agree = np.zeros(len(in_a), bool)
    if len(in_a) >= _FEWEST_MATCHES:
        sizes = [sample.photos[i].shape[:0:-1] for i in (pair.a, pair.b)]
        cv2.setRNGSeed(0)
        _, mask = cv2.findFundamentalMat(
            in_a * sizes[0], in_b * sizes[1], cv2.FM_RANSAC, _RANSAC_PIXELS, 0.99, 500
        )
        agree = agree if mask is None else mask[:, 0] > 0
    share = float(moved.mean()) if len(moved) else 0.0
    return Pair(pair.a, pair.b, in_a[agree], in_b[agree], share)


def _distances(pair: Pair, rig: Rig) -> np.ndarray:
    """(N,) distances from the epipolar lines; infinite for points behind a camera."""
    a, b = rig.rays(pair.a, pair.in_a), rig.rays(pair.b, pair.in_b)
    rotation = rig.rotation[pair.b] @ rig.rotation[pair.a].T
    baseline = rig.translation[pair.b] - rotation @ rig.translation[pair.a]
    if np.linalg.norm(baseline) <= 1e-9 * np.linalg.norm(rig.translation[pair.b]):
        baseline = np.array([1.0, 0.0, 0.0])  # at one place there is no parallax in any direction
    turned = a @ rotation.T  # the rays of the first camera, in the frame of the second
    normal = np.cross(baseline, turned)  # of the epipolar plane; its line in the second photo
    back = np.cross(baseline, b) @ rotation  # the same in the first photo, up to the sign
    # Sampson's distance, a first-order distance from the epipolar line, in relative pixels.
    scale_a = rig.focal[pair.a] * rig.aspect[pair.a]
    scale_b = rig.focal[pair.b] * rig.aspect[pair.b]
    gradient = ((normal[:, :2] / scale_b) ** 2).sum(1) + ((back[:, :2] / scale_a) ** 2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs((normal * b).sum(1)) / np.sqrt(gradient)
    # Depths along both rays: z_b b = z_a turned + baseline, multiplied by each ray.
    across = np.cross(turned, b)
    area = (across**2).sum(1)
    depth_a = (np.cross(b, baseline) * across).sum(1)
    depth_b = (np.cross(turned, baseline) * across).sum(1)
    parallax = np.sqrt(area) / (np.linalg.norm(turned, axis=1) * np.linalg.norm(b, axis=1))
    front = (parallax < _PARALLAX) | ((depth_a > 0) & (depth_b > 0))
    return np.where(front & np.isfinite(distance), distance, np.inf)
