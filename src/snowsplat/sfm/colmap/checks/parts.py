"""Divides the photos of a model into parts that contradict each other.

Two parts of the photos contradict each other if only a small share of the demand between them is
supported (`find_parts`). The best division is the sparsest cut of the graph: the cut with the least
ratio of supported demand to demand. This problem is relaxed to a generalised eigenvalue problem
(Cucuringu, Koutis, Chawla, Miller and Peng, "Simple and scalable constrained clustering: a
generalized spectral method", AISTATS 2016).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snowsplat.scene.epipolar import Floats
from snowsplat.sfm.colmap.checks.consistency import CheckedPair, Ints
from snowsplat.util.components import components

# Two parts contradict each other if both of these conditions hold:
# - At most the share `_MAX_SUPPORT` of the demand between them is supported.
# - Let n be `_MIN_TEARS`, or `_MIN_FOLLOWING_TEARS` if only the pairs of photos that follow each
#   other are examined. Sort the tears between the parts by weight, the largest first, and the
#   confirmed pairs, too. The n-th tear has a larger weight than the n-th confirmed pair, if there
#   is one. (Photos taken side by side have more matches than photos of places that look alike.)
_MAX_SUPPORT = 0.5
_MIN_TEARS = 3
_MIN_FOLLOWING_TEARS = 2
_VECTORS = 6  # number of eigenvectors that are tried
_THRESHOLDS = 10  # number of thresholds that are tried for each eigenvector


def unconfirmed_photos(pairs: Sequence[CheckedPair]) -> set[int]:
    """The photos (image ids) whose pose is doubtful, although no part contradicts another one.

    Such a photo has at least `_MIN_TEARS` tears, but no pair that the model confirms. In a correct
    model, every photo is confirmed by others, even if most of its matches are false.
    """
    tears: Counter[int] = Counter()
    confirmed: set[int] = set()
    for pair in pairs:
        tears.update({pair.first: int(pair.torn), pair.second: int(pair.torn)})
        if pair.counts and pair.confirmed:
            confirmed |= {pair.first, pair.second}
    return {photo for photo, count in tears.items() if count >= _MIN_TEARS} - confirmed


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
    parts = [part for component in _components(demand > 0) for part in _split(graph, component)]
    parts = sorted(_merge(graph, parts), key=lambda part: (-len(part), part[0]))
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
        """Whether the model contradicts the matches between two sets of photos."""
        return self.contradiction(one, other) is not None

    def contradiction(self, one: Sequence[int], other: Sequence[int]) -> float | None:
        """The supported share of the demand between two sets of photos that contradict each other.

        None if they do not. Pairs of photos that follow each other are also examined on their own.
        If these pairs contradict the model, the sets contradict each other, whatever the other
        pairs show: if two whole rooms look alike, hundreds of false pairs agree with each other.
        """
        across = np.ix_(one, other)
        follows = self.follows[across]
        shares = [self._contradiction(across, _MIN_TEARS, np.ones_like(follows))]
        if follows.any():
            shares.append(self._contradiction(across, _MIN_FOLLOWING_TEARS, follows))
        return min((share for share in shares if share is not None), default=None)

    def _contradiction(
        self, across: tuple[Ints, ...], tears: int, pairs: NDArray[np.bool_]
    ) -> float | None:
        torn = _nth_largest(self.torn[across] * pairs, tears)
        if torn <= _nth_largest(self.confirmed[across] * pairs, tears):
            return None
        share = float((self.supported[across] * pairs).sum() / (self.demand[across] * pairs).sum())
        return share if share <= _MAX_SUPPORT else None


def _nth_largest(values: Floats, n: int) -> float:
    """The ``n``-th largest entry; 0 if there are fewer entries."""
    ordered = np.sort(values, axis=None)
    return float(ordered[-n]) if len(ordered) >= n else 0.0


def _components(linked: NDArray[np.bool_]) -> list[list[int]]:
    """The connected components of a graph of N nodes, as sorted lists of nodes. ``linked``: (N, N)
    symmetric, whether two nodes have an edge."""
    first, second = np.nonzero(linked)
    label = components((first, second), len(linked))
    return [np.flatnonzero(label == node).tolist() for node in np.unique(label)]


def _split(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Divide photos into parts, until no part can be divided into two that contradict each other.
    Of all candidates, the division with the smallest supported share of the demand is used."""
    best = None
    for one in itertools.chain(_grown_groups(graph, photos), _sweep_cuts(graph, photos)):
        inside = set(one)
        other = [i for i in photos if i not in inside]
        share = graph.contradiction(one, other)
        if share is not None and (best is None or share < best[0]):
            best = share, one, other
    if best is None:
        yield photos
        return
    for part in best[1:]:
        for component in _components(graph.demand[np.ix_(part, part)] > 0):
            yield from _split(graph, [part[i] for i in component])


def _grown_groups(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of a cut: groups of photos that are linked by pairs with support.

    Each photo starts as a group. The pairs of photos that follow each other are processed first,
    then all other pairs; both in the order of `_Graph.confirmed`, the largest value first. Each
    pair joins the groups of its two photos, unless these groups contradict each other. This finds
    parts that `_sweep_cuts` does not find: those that have many pairs with the rest of the photos.
    """
    group = {photo: [photo] for photo in photos}
    apart: set[tuple[int, int, int, int]] = set()
    rows, columns = np.nonzero(np.triu(graph.supported[np.ix_(photos, photos)]))
    edges = np.take(photos, rows), np.take(photos, columns)
    for edge in np.lexsort((-graph.confirmed[edges], ~graph.follows[edges])):
        one, other = group[photos[rows[edge]]], group[photos[columns[edge]]]
        key = (one[0], len(one), other[0], len(other))
        if one is other or key in apart:
            continue
        if graph.contradicts(one, other):
            apart.add(key)
            continue
        one += other
        for photo in other:
            group[photo] = one
    groups = {id(members): members for members in group.values()}
    if len(groups) > 1:
        yield from (sorted(members) for members in groups.values())


def _sweep_cuts(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of the sparsest cut of ``photos``: sweep cuts of eigenvectors.

    The photos are sorted by their entries in an eigenvector. The first k photos in this order, for
    any k, can be one side of a cut. The `_THRESHOLDS` cuts with the least ratio of supported demand
    to demand are tried.
    """
    count = len(photos)
    if count < 2:
        return
    rows = np.ix_(photos, photos)
    demand, supported = graph.demand[rows], graph.supported[rows]
    scale = demand.sum() / count
    ones = np.ones((count, count)) / count
    # The eigenvalue problem is L(supported) v = λ L(demand) v, where L is the Laplacian. A constant
    # v is a useless solution. Adding `ones` to L(demand) makes this matrix invertible. Adding twice
    # `ones` to L(supported) gives the constant v the eigenvalue 2; all others are between 0 and 1.
    above = _laplacian(supported) / scale + 2 * ones
    below = _laplacian(demand) / scale + ones
    inverse = np.linalg.inv(np.linalg.cholesky(below))
    vectors = inverse.T @ np.linalg.eigh(inverse @ above @ inverse.T)[1][:, :_VECTORS]
    for vector in vectors.T:
        order = np.argsort(vector, kind="stable")
        across_demand = _cut_weights(demand, order)
        across_supported = _cut_weights(supported, order)
        ratio = across_supported / np.maximum(across_demand, 1e-300)
        torn = _cut_weights((graph.torn[rows] > 0).astype(float), order)
        ratio[torn < _MIN_TEARS] = np.inf
        for size in np.argsort(ratio, kind="stable")[:_THRESHOLDS] + 1:
            if ratio[size - 1] <= _MAX_SUPPORT:
                yield sorted(photos[i] for i in order[:size])


def _laplacian(weights: Floats) -> Floats:
    return np.diag(weights.sum(1)) - weights


def _cut_weights(weights: Floats, order: Ints) -> Floats:
    """(N − 1,) the sum of the weights between the first k photos of ``order`` and the other photos.
    The entries are those for k = 1, …, N − 1."""
    sorted_weights = weights[np.ix_(order, order)]
    # When photo k joins the first photos, its edges to them are not cut any more, and its edges to
    # the other photos are cut.
    before = np.tril(sorted_weights).sum(1)
    return np.cumsum(sorted_weights.sum(1) - 2 * before)[:-1]


def _merge(graph: _Graph, parts: list[list[int]]) -> list[list[int]]:
    """Join parts that have supported demand between them and do not contradict each other. The two
    parts with the largest supported demand between them are joined first."""
    parts = [sorted(part) for part in parts]
    while True:
        best = None
        for i, one in enumerate(parts):
            for j, other in enumerate(parts[:i]):
                across = np.ix_(one, other)
                supported = graph.supported[across].sum()
                linked = supported > 0 and not graph.contradicts(one, other)
                if linked and (best is None or supported > best[0]):
                    best = supported, i, j
        if best is None:
            return parts
        _, i, j = best
        parts[j] = sorted(parts[j] + parts.pop(i))
