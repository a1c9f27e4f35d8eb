"""Chooses the pairs of photos to match. Matching all pairs takes quadratic time.

    few photos           all pairs
    frames of a video    each frame with the next frames, with later frames at growing distances,
                         and with frames that look similar. Similar frames close loops: the camera
                         comes back to a place where it was before
    photos with GPS      each photo with the nearest photos, and with some that look similar, if
                         the positions differ by more than their error
    many photos          each photo with those that look similar. A photo with a number in its name
                         is also paired with the photos that have the next numbers, which were
                         usually taken directly after it

If several rules apply, all of them are used, so that all photos are connected by pairs.

If a photo has many similar ones, most of their pairs connect the same points again. So a photo is
first matched with about half of them: with the most similar ones, and with others at growing
distances in the order of similarity, which connect it to other parts of the scene. The other half
is the reserve, for photos of which few pairs have enough matches (`PairChoice.complete`).

Photos look similar if global descriptors of their local features are: VLAD (Jégou et al.,
"Aggregating local descriptors into a compact image representation", CVPR 2010), with the residuals
of each visual word normalised (Arandjelović and Zisserman, "All about VLAD", CVPR 2013). The visual
words are learned from the photos of the dataset, so no vocabulary has to be downloaded. All sums
have a fixed order, so the result depends only on the features.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import MIN_MATCHES, VerifiedPair
from snowsplat.sfm.colmap.options import Effort
from snowsplat.sfm.gps import east_north_up, middle_of, position_errors
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.components import components

# Share of `Effort.neighbours` that is used for similar photos if all photos already have pairs from
# one video or from GPS.
_LOOP_SHARE = 0.4
# Share of `Effort.overlap` that is used for photos with numbered names. Such photos are farther
# apart than the frames of a video, and the next photos are usually among the similar ones anyway.
_NUMBERED_SHARE = 0.5
_NUMBERED_NAME = re.compile(r"(.*?)([0-9]+)\.[^./]*")

# Of the similar photos of a photo, this number of the most similar ones is matched first, and then
# those whose place in the order grows by this factor.
_MOST_SIMILAR, _STEP = 6, 1.25
# A photo with at least this number of pairs that have `MIN_MATCHES` needs no reserve.
_CLEAR_PAIRS = 8

WORDS = 64  # number of visual words
# Number of features of a photo that are used. The largest ones are used, because they are also
# detected in photos from other distances.
FEATURES = 1000
_SAMPLE = 64 * WORDS * 4  # number of descriptors for k-means
_ROUNDS = 12  # iterations of k-means

Pairs = set[tuple[int, int]]
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class PairChoice:
    """Pairs (i < j) of indices in the list of photos, and the rules that chose them, as text.

    Attributes:
        pairs: sorted, those to match.
        reserve: sorted, further pairs, which are only needed by photos with few matches.
    """

    pairs: list[tuple[int, int]]
    rules: str
    reserve: list[tuple[int, int]] = field(default_factory=list)

    @property
    def description(self) -> str:
        """The rules and the number of pairs, as text for users."""
        return f"{self.rules} ({len(self.pairs)} pairs)"

    def complete(self, verified: Sequence[VerifiedPair], count: int) -> PairChoice:
        """This choice, with those pairs of the reserve that are needed.

        These are all pairs of photos that are not well connected; and all pairs, if there are
        several groups of photos without a connection: any pair may be the one between them.

        Args:
            verified: the pairs with verified matches.
            count: number of photos.
        """
        clear = [(p.first - 1, p.second - 1) for p in verified if p.matches >= MIN_MATCHES]
        first, second = np.array(clear, np.int64).reshape(-1, 2).T
        partners = np.bincount(np.concatenate([first, second]), minlength=count)
        groups = np.unique(components((first, second), count)[partners > 0])
        weak = (partners < _CLEAR_PAIRS) | (len(groups) > 1)
        return self._with({(i, j) for i, j in self.reserve if weak[i] or weak[j]})

    def whole(self) -> PairChoice:
        """This choice, with all pairs of the reserve."""
        return self._with(set(self.reserve))

    def _with(self, needed: Pairs) -> PairChoice:
        rest = [pair for pair in self.reserve if pair not in needed]
        return PairChoice(sorted({*self.pairs, *needed}), self.rules, rest)


def choose_pairs(
    photos: Sequence[Photo], effort: Effort, similarity: Callable[[], NDArray[np.floating[Any]]]
) -> PairChoice:
    """Choose the pairs to match.

    ``similarity`` returns the visual similarity of the photos (`similarity`), (N, N). It
    is called only if needed.
    """
    count = len(photos)
    if count <= effort.exhaustive:
        every = list(itertools.combinations(range(count), 2))
        return PairChoice(every, "all pairs of photos")
    pairs: Pairs = set()
    rules = []
    sequences = _sequences(photos)
    if sequences:
        for sequence in sequences:
            # With the next frames, and with those at distances of 2, 4, 8 … times as many frames.
            steps = list(range(1, effort.overlap + 1))
            while steps[-1] * 2 < len(sequence):
                steps.append(steps[-1] * 2)
            pairs |= pairs_following(sequence, steps)
        rules.append("frames of a video with the following frames")
    overlap = round(_NUMBERED_SHARE * effort.overlap)
    names = {i: photo.name for i, photo in enumerate(photos) if photo.sequence is None}
    numbered = [pairs_following(series, range(1, overlap + 1)) for series in numbered_series(names)]
    if numbered:
        pairs |= set().union(*numbered)
        rules.append("photos with the next photos by name")
    near, located = _near_pairs(photos, effort.neighbours)
    if near:
        pairs |= near
        rules.append("photos with the nearest photos by GPS")
    covered = located == count or sum(map(len, sequences)) == count
    # A frame is most similar to the frames directly before and after it, which are already paired
    # with it. They are excluded here; otherwise no pair would close a loop.
    alike = similarity().copy()
    for sequence in sequences:
        for position, i in enumerate(sequence):
            around = sequence[max(0, position - effort.overlap) : position + effort.overlap + 1]
            alike[i, around] = -np.inf
    rules.append("photos with similar photos")
    if covered:
        pairs |= nearest(alike, range(round(_LOOP_SHARE * effort.neighbours)))
        return PairChoice(sorted(pairs), ", ".join(rules))
    places = range(effort.neighbours)
    pairs |= nearest(alike, _growing(places))
    reserve = nearest(alike, places) - pairs
    return PairChoice(sorted(pairs), ", ".join(rules), sorted(reserve))


def _growing(places: range) -> list[int]:
    """Some places in an order: the first ones, then at growing distances."""
    chosen = list(places[:_MOST_SIMILAR])
    while chosen and (place := math.ceil(_STEP * (chosen[-1] + 1)) - 1) in places:
        chosen.append(place)
    return chosen


def numbered_series(names: Mapping[int, str]) -> list[list[int]]:
    """Series of photos whose names differ only in the last number, in the order of this number.

    ``names``: any number that identifies a photo -> its file name (IMG_0017.jpg). The series
    contain these identifiers. Series of a single photo are left out.
    """
    by_prefix: dict[str, list[tuple[int, int]]] = {}
    for i, name in names.items():
        parts = _NUMBERED_NAME.fullmatch(name)
        if parts is not None:
            by_prefix.setdefault(parts[1], []).append((int(parts[2]), i))
    return [[i for _, i in sorted(series)] for series in by_prefix.values() if len(series) > 1]


def pairs_following(series: Sequence[int], steps: Sequence[int]) -> Pairs:
    """Pairs (i < j) of entries of ``series`` whose positions differ by one of ``steps``."""
    pairs = set()
    for position, i in enumerate(series):
        for step in steps:
            if position + step < len(series):
                j = series[position + step]
                pairs.add((min(i, j), max(i, j)))
    return pairs


def _sequences(photos: Sequence[Photo]) -> list[list[int]]:
    by_name: dict[str, list[int]] = {}
    for i, photo in enumerate(photos):
        if photo.sequence is not None:
            by_name.setdefault(photo.sequence, []).append(i)
    return [sorted(frames, key=lambda i: photos[i].name) for frames in by_name.values()]


def _near_pairs(photos: Sequence[Photo], neighbours: int) -> tuple[Pairs, int]:
    """Pairs of photos that are near by GPS, and the number of photos whose neighbours are known.

    If more than ``neighbours`` photos are within the error of a position, GPS cannot tell which of
    them are nearest. This happens indoors, where phones also store the last position outdoors.
    """
    located = [i for i, photo in enumerate(photos) if photo.location is not None]
    if len(located) <= neighbours:
        return set(), 0
    locations = np.array([photos[i].location for i in located])
    places = east_north_up(locations, middle_of(locations))[:, :2]
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    errors = position_errors([photos[i] for i in located])
    within = (distances <= errors[:, None]).sum(axis=1) - 1  # the photo itself is not counted
    clear = np.flatnonzero(within <= neighbours)
    pairs: Pairs = set()
    for i in clear:
        order = np.argsort(distances[i], kind="stable")
        for j in order[order != i][:neighbours]:
            pairs.add((located[min(i, j)], located[max(i, j)]))
    return pairs, len(clear)


def similarity(descriptors: Sequence[Floats]) -> Floats:
    """(N, N) float32 similarity of N photos, from −1 to 1.

    The diagonal is 1. A photo without features has the similarity 0 to all others.

    Args:
        descriptors: for each photo, (n, D): the descriptors of n local features.
    """
    counts = [len(d) for d in descriptors]
    if sum(counts) == 0:
        return np.eye(len(descriptors), dtype=np.float32)
    words = _learn_words(np.concatenate([_unit(d) for d in descriptors if len(d)]))
    vectors = np.stack([_describe(_unit(d), words) for d in descriptors])
    # Subtract the mean: the features that all photos have in common do not distinguish them.
    seen = np.array(counts) > 0
    vectors[seen] = _unit(vectors[seen] - vectors[seen].mean(0))
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, 1.0)
    return alike


def nearest(alike: Floats, places: Iterable[int]) -> set[tuple[int, int]]:
    """Pairs (i < j) of each photo with the similar ones at these places in the order of similarity.

    Args:
        alike: (N, N) similarity.
        places: 0 is the most similar photo.
    """
    pairs = set()
    for i, row in enumerate(alike):
        order = [int(j) for j in np.argsort(-row, kind="stable") if j != i]
        for j in [order[place] for place in places if place < len(order)]:
            pairs.add((min(i, j), max(i, j)))
    return pairs


def _unit(rows: Floats) -> Floats:
    rows = np.asarray(rows, np.float32)
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.maximum(norm, 1e-12)


def _learn_words(points: Floats) -> Floats:
    # k-means on evenly chosen descriptors. A word to which no descriptor is assigned is not moved.
    sample = points[:: max(1, len(points) // _SAMPLE)]
    words = sample[:: max(1, len(sample) // WORDS)][:WORDS].copy()
    for _ in range(_ROUNDS):
        nearest_word = _assign(sample, words)
        for k in range(len(words)):
            members = sample[nearest_word == k]
            if len(members):
                words[k] = members.mean(0)
    return words


def _assign(points: Floats, words: Floats) -> NDArray[np.intp]:
    # The index of the nearest word of each point: |p − w|² = |p|² − 2 p·w + |w|², and the first
    # term does not affect the minimum.
    return np.argmin((words**2).sum(1) - 2 * points @ words.T, axis=1)


def _describe(points: Floats, words: Floats) -> Floats:
    """The VLAD vector of a photo, from its (n, D) descriptors."""
    vector = np.zeros_like(words)
    if len(points):
        word = _assign(points, words)
        for k in np.unique(word):
            vector[k] = (points[word == k] - words[k]).sum(0)
    vector = _unit(vector)
    return _unit(vector.reshape(1, -1))[0]
