"""Which pairs of photos are compared: comparing each with each is quadratic, and rarely needed.

    few photos           each with each
    frames of a video    with the next ones, ever sparser further on, and with those that look
                         alike: where the walk comes back to a place, the loop is closed
    photos with GPS      with the nearest, and some that look alike
    many photos          with those that look alike

A mix of these is compared by each rule that holds, so that parts are joined.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.options import Effort
from snowsplat.sfm.colmap.retrieval import nearest
from snowsplat.sfm.ingest.photo import Photo

_METRES_PER_DEGREE = 111_320.0
# A video has most of its pairs from the order in time already.
_LOOP_SHARE = 0.4

Pairs = set[tuple[int, int]]


@dataclass(frozen=True)
class PairChoice:
    """Pairs (i < j) of indices into the list of photos, sorted, and how they were chosen."""

    pairs: list[tuple[int, int]]
    words: str


def choose_pairs(
    photos: Sequence[Photo], effort: Effort, alike: Callable[[], NDArray[np.floating[Any]]]
) -> PairChoice:
    """The pairs to compare.

    ``alike`` gives how alike the photos look, (N, N); it is asked only where that is needed.
    """
    count = len(photos)
    if count <= effort.exhaustive:
        every = list(itertools.combinations(range(count), 2))
        return PairChoice(every, f"each photo with each ({len(every)} pairs)")
    pairs: Pairs = set()
    words = []
    sequences = _sequences(photos)
    if sequences:
        for sequence in sequences:
            pairs |= _along(sequence, effort.overlap)
        words.append("frames of a video with the next ones")
    located = [i for i, photo in enumerate(photos) if photo.location is not None]
    if len(located) > effort.neighbours:
        places = _metres(np.array([photos[i].location for i in located]))
        pairs |= {
            (located[i], located[j]) for i, j in nearest(-_distances(places), effort.neighbours)
        }
        words.append("photos with the nearest by GPS")
    covered = len(located) == count or sum(map(len, sequences)) == count
    share = _LOOP_SHARE if covered else 1.0
    pairs |= _look_alike(photos, alike(), round(share * effort.neighbours), effort.overlap)
    words.append("photos with those that look alike")
    return PairChoice(sorted(pairs), f"{', '.join(words)} ({len(pairs)} pairs)")


def _sequences(photos: Sequence[Photo]) -> list[list[int]]:
    by_name: dict[str, list[int]] = {}
    for i, photo in enumerate(photos):
        if photo.sequence is not None:
            by_name.setdefault(photo.sequence, []).append(i)
    return [sorted(frames, key=lambda i: photos[i].name) for frames in by_name.values()]


def _along(sequence: Sequence[int], overlap: int) -> Pairs:
    # Every frame with the next few, then with those 2, 4, 8 … times as far.
    steps = list(range(1, overlap + 1))
    while steps[-1] * 2 < len(sequence):
        steps.append(steps[-1] * 2)
    pairs = set()
    for position, i in enumerate(sequence):
        for step in steps:
            if position + step < len(sequence):
                j = sequence[position + step]
                pairs.add((min(i, j), max(i, j)))
    return pairs


def _look_alike(
    photos: Sequence[Photo], alike: NDArray[np.floating[Any]], count: int, overlap: int
) -> Pairs:
    # A frame looks most like its neighbours in time, which are paired already: leave them out, or
    # no loop is ever found.
    alike = alike.copy()
    for sequence in _sequences(photos):
        for position, i in enumerate(sequence):
            near = sequence[max(0, position - overlap) : position + overlap + 1]
            alike[i, near] = -np.inf
    return nearest(alike, count)


def _metres(locations: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    # Flat around the middle; the altitude of GPS is too rough to tell neighbours.
    latitude, longitude = locations[:, 0], locations[:, 1]
    middle = np.radians(latitude.mean())
    east = (longitude - longitude.mean()) * np.cos(middle)
    return np.stack([east, latitude - latitude.mean()], 1) * _METRES_PER_DEGREE


def _distances(places: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    return np.linalg.norm(places[:, None] - places[None], axis=2)
