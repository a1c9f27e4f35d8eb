"""Divides the photos of a model into parts that contradict each other.

Two parts of the photos contradict each other if only a small share of the demand between them is
supported. Parts grow along the pairs that the model confirms, as in Kruskal's algorithm for the
maximum spanning tree of the view graph, but those that contradict each other are not joined.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snowsplat.scene.epipolar import Floats
from snowsplat.sfm.colmap.checks.consistency import CheckedPair
from snowsplat.sfm.colmap.checks.matches import Ints

# Two parts contradict each other if both of these conditions hold:
# - At most the share `_MAX_SUPPORT` of the demand between them is supported.
# - Let n be `_MIN_TEARS`, or `_MIN_FOLLOWING_TEARS` if only the pairs of photos that follow each
#   other are examined. Sort the tears between the parts by weight, the largest first, and the
#   confirmed pairs, too. The n-th tear has a larger weight than the n-th confirmed pair, if there
#   is one. (Photos taken side by side have more matches than photos of places that look alike.)
_MAX_SUPPORT = 0.5
_MIN_TEARS = 3
_MIN_FOLLOWING_TEARS = 2


def find_parts(pairs: Sequence[CheckedPair]) -> list[set[int]]:
    """The parts of a model that contradict each other: sets of image ids.

    The first set contains the photos of the largest part, and of all parts that do not contradict
    it. Each of the other parts is one set. So there is only one set for a model without
    contradictions. Photos without a pair that counts are in no set.
    """
    pairs = [pair for pair in pairs if pair.counts]
    ids = sorted({i for pair in pairs for i in (pair.first, pair.second)})
    if not ids:
        return []
    index = {image_id: row for row, image_id in enumerate(ids)}
    demand = np.zeros((len(ids), len(ids)))
    supported, torn, confirmed = demand.copy(), demand.copy(), demand.copy()
    follows = np.zeros(demand.shape, bool)
    for pair in pairs:
        i, j = index[pair.first], index[pair.second]
        demand[i, j] = demand[j, i] = pair.weight**2
        supported[i, j] = supported[j, i] = pair.weight**2 * pair.support
        torn[i, j] = torn[j, i] = pair.weight * pair.torn
        confirmed[i, j] = confirmed[j, i] = pair.weight * pair.confirmed
        follows[i, j] = follows[j, i] = pair.follows
    graph = _Graph(demand, supported, torn, confirmed, follows)
    parts = sorted(_grown_groups(graph), key=lambda part: (-len(part), part[0]))
    kept: list[int] = []
    cut = []
    for part in parts:
        if kept and graph.contradicts(part, kept):
            cut.append(part)
        else:
            kept += part
    return [{ids[row] for row in part} for part in [kept, *cut]]


@dataclass(frozen=True)
class _Graph:
    """The pairs of N photos as symmetric (N, N) matrices; the diagonals are zero."""

    demand: Floats  # the squared `CheckedPair.weight`
    supported: Floats  # the demand multiplied by `CheckedPair.support`
    torn: Floats  # `CheckedPair.weight` of tears, 0 for other pairs
    confirmed: Floats  # `CheckedPair.weight` of confirmed pairs, 0 for other pairs
    follows: NDArray[np.bool_]  # whether the photos follow each other

    def contradicts(self, one: Sequence[int], other: Sequence[int]) -> bool:
        """Whether the model contradicts the matches between two sets of photos.

        Pairs of photos that follow each other are also examined on their own. If these pairs
        contradict the model, the sets contradict each other, whatever the other pairs show: if two
        whole rooms look alike, hundreds of false pairs agree with each other.
        """
        across = np.ix_(one, other)
        follows = self.follows[across]
        return self._contradicts(across, _MIN_TEARS, np.ones_like(follows)) or (
            bool(follows.any()) and self._contradicts(across, _MIN_FOLLOWING_TEARS, follows)
        )

    def _contradicts(self, across: tuple[Ints, ...], tears: int, pairs: NDArray[np.bool_]) -> bool:
        torn = _nth_largest(self.torn[across] * pairs, tears)
        if torn <= _nth_largest(self.confirmed[across] * pairs, tears):
            return False
        supported, demand = (self.supported[across] * pairs).sum(), self.demand[across] * pairs
        return bool(supported <= _MAX_SUPPORT * demand.sum())


def _nth_largest(values: Floats, n: int) -> float:
    """The ``n``-th largest entry; 0 if there are fewer entries."""
    ordered = np.sort(values, axis=None)
    return float(ordered[-n]) if len(ordered) >= n else 0.0


def _grown_groups(graph: _Graph) -> list[list[int]]:
    """Groups of photos that pairs with support link, and that do not contradict each other.

    Each photo starts as a group. The pairs of photos that follow each other are processed first,
    then all other pairs; both in the order of `_Graph.confirmed`, the largest value first. Each
    pair joins the groups of its two photos, unless these groups contradict each other.
    """
    group = {photo: [photo] for photo in range(len(graph.demand))}
    apart: set[tuple[int, int, int, int]] = set()
    edges = np.nonzero(np.triu(graph.supported))
    for edge in np.lexsort((-graph.confirmed[edges], ~graph.follows[edges])):
        one, other = group[edges[0][edge]], group[edges[1][edge]]
        key = (one[0], len(one), other[0], len(other))
        if one is other or key in apart:
            continue
        if graph.contradicts(one, other):
            apart.add(key)
            continue
        one += other
        for photo in other:
            group[photo] = one
    return [sorted(members) for members in {id(found): found for found in group.values()}.values()]
