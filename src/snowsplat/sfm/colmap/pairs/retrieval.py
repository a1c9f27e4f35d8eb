"""Visual similarity of photos, from global descriptors that are computed from local features.

The global descriptor is VLAD (Jégou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010), with the residuals of each visual word normalised (Arandjelović and
Zisserman, "All about VLAD", CVPR 2013). The visual words are learned from the photos of the
dataset, so no vocabulary has to be downloaded. All sums have a fixed order, so the result depends
only on the features.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

WORDS = 64  # number of visual words
# Number of features of a photo that are used. The largest ones are used, because they are also
# detected in photos from other distances.
FEATURES = 1000
_SAMPLE = 64 * WORDS * 4  # number of descriptors for k-means
_ROUNDS = 12  # iterations of k-means


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
