"""A subset of the photos that is spread over the scene, from which a model is made first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.colmap.pairs import numbered_series
from snowsplat.sfm.colmap.view_graph import ViewGraph

# A photo may be left out if the photos of the subset with which it has at least this number of
# verified matches stay connected by pairs with as many matches.
_MIN_MATCHES = 100


def spread_subset(graph: ViewGraph, count: int) -> set[int]:
    """``count`` photos (image ids) or a few more, which are connected by strong pairs.

    Photos are left out one after the other, those with the strongest pairs first. A photo stays in
    the subset if the pairs between the others would become weak without it (`_MIN_MATCHES`): pairs
    of its neighbours in the view graph, and the pair of the photos before and after it by name.
    """
    ids, matches = graph.matrix()
    row = {photo: index for index, photo in enumerate(ids)}
    kept = np.ones(len(ids), bool)
    series_of = {
        row[photo]: [row[other] for other in series]
        for series in numbered_series(graph.names)
        for photo in series
    }
    strong = matches >= _MIN_MATCHES

    def needed(index: int) -> bool:
        series = series_of.get(index, [])
        if series:
            position = series.index(index)
            before = [i for i in series[:position] if kept[i]]
            after = [i for i in series[position + 1 :] if kept[i]]
            if before and after and not strong[before[-1], after[0]]:
                return True
        near = np.flatnonzero(kept & strong[index])
        return len(near) < 2 or not _connected(strong[np.ix_(near, near)])

    while kept.sum() > count:
        rows = np.flatnonzero(kept)
        # The second strongest pair: a photo with one strong pair only is at the end of a walk.
        second = np.sort(matches[np.ix_(rows, rows)], axis=1)[:, -2]
        unneeded = (int(i) for i in rows[np.argsort(-second, kind="stable")] if not needed(int(i)))
        index = next(unneeded, None)
        if index is None:
            break
        kept[index] = False
    return {photo for photo, keep in zip(ids, kept, strict=True) if keep}


def _connected(linked: NDArray[np.bool_]) -> bool:
    """Whether a graph is connected; ``linked`` (N, N): whether two nodes have an edge; N ≥ 1."""
    reached = np.zeros(len(linked), bool)
    reached[0] = True
    while True:
        more = reached | linked[reached].any(0)
        if (more == reached).all():
            return bool(reached.all())
        reached = more
