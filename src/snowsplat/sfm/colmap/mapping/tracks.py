"""Chooses the matches with which a model is made first: those of the longest tracks.

A track is a set of features that verified matches connect: the images of one point. The time of the
mapper and of bundle adjustment is proportional to the number of features. The longest tracks tell
most about the poses: they connect many photos, and a point that is seen from many sides is the most
accurate. The other matches are used when all poses are known. (Moulon, Monasse and Marlet choose
tracks with union-find in "Adaptive structure from motion", ACCV 2012; Cui, Shen and Hu bound their
number in "Efficient and robust large-scale structure from motion via track selection", 2016.)
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from snowsplat.util.components import Ints, components

#: A pair of photos keeps at least this share of its matches, and at least this number, or all. The
#: share keeps the order of the pairs: those of photos that only look alike have few matches.
SHARE, LEAST = 0.25, 20


def of_long_tracks(
    matches: Sequence[tuple[int, int, Ints]],
    counts: Mapping[int, int],
    share: float = SHARE,
    least: int = LEAST,
) -> list[NDArray[np.bool_]]:
    """For each pair of photos, which of its matches belong to the chosen tracks; (M,) each.

    Of each pair, the ``share`` of its matches whose tracks are longest is chosen, and at least the
    number ``least``. A track keeps its matches in all pairs.

    Args:
        matches: for each pair, two image ids, and (M, 2) the indices of the matched features.
        counts: image id -> number of features.
    """
    ids = sorted(counts)
    start = dict(zip(ids, np.cumsum([0, *(counts[i] for i in ids)]).tolist(), strict=False))
    total = sum(counts.values())
    photo = np.repeat(np.arange(len(ids)), [counts[i] for i in ids])  # of a feature
    sizes = [len(rows) for _, _, rows in matches]
    if not sum(sizes):
        return [np.zeros(size, bool) for size in sizes]
    pair = np.repeat(np.arange(len(matches)), sizes)
    first = np.concatenate([rows[:, 0] + start[i] for i, _, rows in matches]).astype(np.int64)
    second = np.concatenate([rows[:, 1] + start[j] for _, j, rows in matches]).astype(np.int64)
    track = components((first, second), total)
    of_match = track[first]
    length = _lengths(track, photo)[of_match]
    order = np.lexsort((first, -length, pair))  # the first features of a photo are the largest
    rank = np.empty(len(pair), np.int64)
    rank[order] = np.arange(len(pair)) - np.searchsorted(pair, pair)  # ``pair`` is sorted
    chosen = np.zeros(total, bool)
    kept = np.maximum(least, share * np.array(sizes))
    chosen[of_match[rank < kept[pair]]] = True
    return np.split(chosen[of_match], np.cumsum(sizes)[:-1])


def _lengths(track: Ints, photo: Ints) -> Ints:
    """(T,) the number of photos of each track, less the number of further features in them. A track
    with several features in one photo has false matches, or repeated structures."""
    features = np.bincount(track, minlength=len(track))
    in_photos = np.unique(track.astype(np.int64) * (int(photo.max()) + 1) + photo)
    photos = np.bincount(in_photos // (int(photo.max()) + 1), minlength=len(track))
    return np.asarray(2 * photos - features)
