"""Many values told by few: levels for single numbers, a palette for rows of them (k-means).

Deterministic: the same values give the same books.
"""

import numpy as np

LEVELS = 256
_ITERATIONS = 40  # of the levels; they move by less than float32 resolves long before
_QUANTILES, _CAPPINGS, _MOST_LEVELS = 4096, 20, 4
_PALETTE_ITERATIONS = 6
_SAMPLE = 32_768  # rows that the coarse clusters are found with
_CHUNK = 1 << 22  # distances held at a time


def levels_for(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """256 ascending levels (float32) for finite ``values`` of any shape, and the nearest's index.

    Lloyd's iteration, each step exact: over sorted values a level's cell is an interval, and its
    mean comes from running sums. It starts from levels as dense as the cube root of the density of
    the values, which is where many levels are best (Panter and Dite, 1951): between quantiles,
    where the density is one over their distance d, that gives a share of d · d^(-1/3).
    """
    if not values.size:
        return np.zeros(LEVELS, np.float32), np.zeros(values.shape, np.uint8)
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    quantiles = ordered[np.linspace(0, len(ordered) - 1, _QUANTILES).round().astype(int)]
    share = np.diff(quantiles) ** (2 / 3)
    for _ in range(_CAPPINGS):  # few values, far away, want few levels, not many
        share = np.minimum(share, share.sum() * _MOST_LEVELS / LEVELS)
    total = np.concatenate([[0.0], np.cumsum(share)])
    levels = np.interp((np.arange(LEVELS) + 0.5) / LEVELS * total[-1], total, quantiles)
    for _ in range(_ITERATIONS):
        cuts = np.searchsorted(ordered, (levels[1:] + levels[:-1]) / 2)
        cuts = np.concatenate([[0], cuts, [len(ordered)]])
        inside = np.diff(cuts)
        means = np.diff(sums[cuts]) / np.maximum(inside, 1)
        moved = np.where(inside > 0, means, levels)
        if np.array_equal(moved, levels):
            break
        levels = np.maximum.accumulate(moved)  # rounding of the sums may swap neighbours
    levels = levels.astype(np.float32)
    middles = (levels[1:].astype(np.float64) + levels[:-1]) / 2
    return levels, np.searchsorted(middles, values).astype(np.uint8)


def palette_for(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most ``count`` rows (P, D) that stand for ``rows`` (N, D) float32, and which one, (N,).

    In two levels, since N · P distances would take minutes: about √count clusters of the rows, each
    with palette entries of its own, as many as its share of the rows.
    """
    if len(rows) <= count:
        return rows, np.arange(len(rows))
    random = np.random.default_rng(0)
    sample = rows if len(rows) <= _SAMPLE else rows[_choose(random, len(rows), _SAMPLE)]
    coarse = _kmeans(sample, max(1, round(count**0.5)), random)
    cluster = _nearest(rows, coarse)
    order = np.argsort(cluster, kind="stable")
    ends = np.cumsum(np.bincount(cluster, minlength=len(coarse)))
    # One for each cluster; of the others shares by rounding the running total, so that all of them
    # add up to the count.
    sizes = np.diff(ends, prepend=0)
    spare = count - np.count_nonzero(sizes)
    shares = (sizes > 0) + np.diff(np.rint(ends / len(rows) * spare).astype(int), prepend=0)
    parts, labels, start = [], np.empty(len(rows), np.int64), 0
    for members, share in zip(np.split(order, ends[:-1]), shares, strict=True):
        if not len(members):
            continue
        own = _kmeans(rows[members], share, random)
        labels[members] = start + _nearest(rows[members], own)
        parts.append(own)
        start += len(own)
    return np.concatenate(parts), labels


def _kmeans(rows: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """At most ``count`` centres (C, D) of the rows, by a few steps of Lloyd's iteration."""
    if len(rows) <= count:
        return rows
    centres = rows[_choose(random, len(rows), count)]
    for _ in range(_PALETTE_ITERATIONS):
        label = _nearest(rows, centres)
        order = np.argsort(label, kind="stable")
        used, starts, sizes = np.unique(label[order], return_index=True, return_counts=True)
        sums = np.add.reduceat(rows[order], starts)
        centres = centres.copy()
        centres[used] = sums / sizes[:, None].astype(np.float32)
    return centres


def _nearest(rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(N,) index of the nearest centre, in pieces of bounded memory."""
    half_norms = 0.5 * (centres * centres).sum(1)
    label = np.empty(len(rows), np.int64)
    step = max(1, _CHUNK // len(centres))
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        label[part] = (rows[part] @ centres.T - half_norms).argmax(1)
    return label


def _choose(random: np.random.Generator, total: int, count: int) -> np.ndarray:
    return np.sort(random.choice(total, count, replace=False))
