"""`ColourEvidence`: do the points have the colours of the photos where the cameras see them?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snowsplat.data.judge.rig import Rig

# Points that are projected, and those among which neighbours are sought.
_MOST_POINTS = 50_000
_NEIGHBOUR_POINTS = 8000
# Points that a view must see to be judged.
_FEWEST_SEEN = 30
# Cells of a photo along each side. Of the points in one cell the nearest hides the others.
_CELLS = 48
# The correlation between the colours of neighbouring points. Points made at random have 0, with
# a standard deviation below 0.03; surfaces have 0.5 and more.
_NEIGHBOURS = 0.2
_NEIGHBOUR_QUERIES = 500
# A view agrees if at most this share of other pictures fits the colours of its points as well. So
# this is the probability that it agrees if the poses are wrong. The other one: if they are right.
_OTHERS, _AGREES = 0.15, 0.9


@dataclass(frozen=True)
class Agreement:
    """How well colours agree.

    Attributes:
        correlation: between the colours of points and pixels, the mean over the views.
        judged: number of views that see enough points.
        odds: nats; how much more probable the colours are than if cameras and points said nothing.
            A view agrees if its points fit its photo better than nearly all other photos, or the
            same photo flipped.
        odds_of_all: the same, if the points should be in all views: one that sees too few does not
            agree.
    """

    correlation: float
    judged: int
    odds: float
    odds_of_all: float


class ColourEvidence:
    """The colours of points against those of photos.

    Args:
        photos: (4, h, w) uint8 RGBA each, in order.
        xyz: (P, 3) points in the world frame.
        rgb: (P, 3) uint8, their colours.
    """

    def __init__(self, photos: Sequence[np.ndarray], xyz: np.ndarray, rgb: np.ndarray) -> None:
        chosen = np.random.default_rng(0).permutation(len(xyz))[:_MOST_POINTS]
        self.photos = photos
        self.xyz = xyz[chosen].astype(np.float64)
        self.rgb = rgb[chosen].astype(np.float32)

    def informative(self) -> bool:
        """Whether points close to each other have similar colours, as those of surfaces have.

        Points at random positions, or of one colour, say nothing about cameras.
        """
        queries = self.xyz[:_NEIGHBOUR_QUERIES]
        points = self.xyz[:_NEIGHBOUR_POINTS]
        distance = (points**2).sum(1) - 2 * queries @ points.T
        distance[range(len(queries)), range(len(queries))] = np.inf
        nearest = distance.argmin(1)
        return _correlation(self.rgb[: len(queries)], self.rgb[nearest]) > _NEIGHBOURS

    def correlation(self, rig: Rig, points: np.ndarray | None = None, most: int = 0) -> float:
        """The mean correlation over the views; a view that sees too few points counts as 0.

        Args:
            rig: the cameras of the photos.
            points: (3, 3), a linear map of the points.
            most: number of points that are projected; 0: all.
        """
        found = self._visible(rig, points, most)
        values = [self._fit(i, i, seen) for i, seen in enumerate(found)]
        return float(np.mean(values)) if values else 0.0

    def agreement(self, rig: Rig, points: np.ndarray | None = None) -> Agreement:
        """See `Agreement`; the arguments are those of `correlation`."""
        found = self._visible(rig, points, 0)
        own, odds = [0.0] * len(found), []
        for i, seen in enumerate(found):
            if len(seen[0]) < _FEWEST_SEEN:
                continue
            own[i] = self._fit(i, i, seen)
            # The photos before and after it may look alike.
            others = [self._fit(i, j, seen) for j in range(len(found)) if abs(i - j) > 1]
            index, where = seen
            for flip in ((1, 0), (0, 1), (1, 1)):
                flipped = np.abs(np.array(flip) - where)
                others.append(self._fit(i, i, (index, flipped)))
            agrees = np.mean(np.array(others) >= own[i]) <= _OTHERS
            right, wrong = (_AGREES, _OTHERS) if agrees else (1 - _AGREES, 1 - _OTHERS)
            odds.append(math.log(right / wrong))
        blind = (len(found) - len(odds)) * math.log((1 - _AGREES) / (1 - _OTHERS))
        mean = float(np.mean(own)) if own else 0.0
        return Agreement(mean, len(odds), sum(odds) if odds else blind, sum(odds) + blind)

    def _visible(
        self, rig: Rig, points: np.ndarray | None, most: int
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each view the indices (N,) of the points that it sees, and where (N, 2)."""
        xyz = self.xyz[: most or None]
        if points is not None:
            xyz = xyz @ points.T
        found = []
        for view in range(len(rig)):
            seen, where, depth = rig.inside(view, xyz)
            cell = (where * _CELLS).astype(np.int64)
            key = cell[:, 1] * _CELLS + cell[:, 0]
            order = np.lexsort((depth, key))
            nearest = order[np.flatnonzero(np.diff(key[order], prepend=-1))]
            found.append((seen[nearest], where[nearest]))
        return found

    def _fit(self, view: int, photo: int, seen: tuple[np.ndarray, np.ndarray]) -> float:
        """The correlation of the points that ``view`` sees with a photo at the same positions."""
        index, where = seen
        picture = self.photos[photo]
        height, width = picture.shape[1:]
        column = np.minimum((where[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum((where[:, 1] * height).astype(np.int64), height - 1)
        pixels = picture[:, row, column]
        opaque = pixels[3] >= 128
        if opaque.sum() < _FEWEST_SEEN:
            return 0.0
        return _correlation(self.rgb[index[opaque]], pixels[:3, opaque].T.astype(np.float32))


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two sets of colours (N, 3), after subtracting the mean colour of each."""
    a, b = a - a.mean(0), b - b.mean(0)
    norm = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / norm if norm > 0 else 0.0
