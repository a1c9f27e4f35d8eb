"""Chooses the photos from which a model is made first: a subset that is spread over the scene."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.mapping.view_graph import ViewGraph
from snowsplat.sfm.colmap.pairs.choice import numbered_series
from snowsplat.util.components import components

_MIN_MATCHES = 100  # number of verified matches of a strong pair
# Two photos of the subset that follow each other by name are at most this number of positions apart
# in the series of all photos. Even photos of equal rooms can be a strong pair.
_MAX_GAP = 4


def spread_subset(graph: ViewGraph, count: int) -> set[int]:
    """``count`` photos (image ids), or more if fewer photos can be left out.

    Photos are left out one after the other: the next one is the photo whose second strongest pair
    has the most matches. A photo is not left out if one of these conditions holds:

    - It has fewer than two strong pairs (`_MIN_MATCHES`) with the photos of the subset.
    - Strong pairs would not connect the other photos of these pairs without it.
    - It is the first or last photo of a series of names.
    - The photos before and after it by name are no strong pair, or more than `_MAX_GAP` positions
      apart. Of four photos of the subset in a row, two photos with one photo between them must be a
      strong pair, too: a photo is registered from points that two photos before it see.
    """
    ids, matches = graph.matrix()
    strong = matches >= _MIN_MATCHES
    kept = np.ones(len(ids), bool)
    row = {photo: index for index, photo in enumerate(ids)}
    before: dict[int, int | None] = {}  # row of a photo -> row of the kept photo before it by name
    after: dict[int, int | None] = {}
    position: dict[int, int] = {}  # in the series
    for series in numbered_series(graph.names):
        position |= {row[photo]: place for place, photo in enumerate(series)}
        for i, j in itertools.pairwise(series):
            after[row[i]], before[row[j]] = row[j], row[i]

    def needed(index: int) -> bool:
        if index in position:
            one, other = before.get(index), after.get(index)
            if one is None or other is None:
                return True
            links = [(one, other), (before.get(one), other), (one, after.get(other))]
            weak = any(None not in link and not strong[link] for link in links)
            if weak or position[other] - position[one] > _MAX_GAP:
                return True
        near = np.flatnonzero(strong[index])
        edges = np.nonzero(strong[np.ix_(near, near)])
        return len(near) < 2 or bool(components(edges, len(near)).any())

    # The number of matches of the second strongest pair of each photo. It is small for a photo at
    # the end of a walk, which may have one strong pair only.
    second = _second_largest(matches)
    is_needed = np.zeros(len(ids), bool)  # is computed again only if a neighbour is left out
    while kept.sum() > count:
        rows = np.flatnonzero(kept & ~is_needed)
        for index in rows[np.argsort(-second[rows], kind="stable")].tolist():
            is_needed[index] = needed(index)
            if not is_needed[index]:
                break
        else:
            break
        kept[index] = False
        one, other = before.pop(index, None), after.pop(index, None)
        if one is not None:
            after[one] = other
            is_needed[one] = False
        if other is not None:
            before[other] = one
            is_needed[other] = False
        is_needed[strong[index]] = False
        strong[index] = strong[:, index] = False
        near = np.flatnonzero(matches[index])
        matches[index] = matches[:, index] = 0
        second[near] = _second_largest(matches[near])
    return {photo for photo, keep in zip(ids, kept, strict=True) if keep}


def _second_largest(values: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """The second largest entry of each row of (N, M) values; 0 if M < 2."""
    return np.partition(values, -2)[:, -2] if values.shape[1] > 1 else np.zeros(len(values))
