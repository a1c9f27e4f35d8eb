"""Vector quantisation by k-means: 256 levels for single numbers, a palette for rows of numbers.

The results are deterministic.
"""

import numpy as np

LEVELS = 256
_ITERATIONS = 40  # for the levels; they converge to float32 precision in fewer
_QUANTILES = 4096
# The share of an interval between quantiles is limited to _MOST_LEVELS levels, in _CAPPINGS
# iterations.
_MOST_LEVELS = 4
_CAPPINGS = 20
_PALETTE_ITERATIONS = 6
_SAMPLE = 32_768  # rows from which the coarse clusters are computed
_CHUNK = 1 << 22  # distances in memory at a time


def levels_for(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise finite ``values`` of any shape to 256 levels.

    Returns the levels (256,) float32, ascending, and the uint8 index of the nearest level for each
    value.

    This is Lloyd's iteration with exact steps: in sorted values, the cell of a level is an
    interval, and its mean is computed from cumulative sums. Initially, the density of levels is
    proportional to the cube root of the density of values, which is optimal for many levels (P.
    Panter and W. Dite, "Quantization distortion in pulse-count modulation with nonuniform spacing
    of levels", 1951). Between two quantiles at distance d the density of values is proportional to
    1/d, so this interval receives a share of levels proportional to d · d^(-1/3).
    """
    if not values.size:
        return np.zeros(LEVELS, np.float32), np.zeros(values.shape, np.uint8)
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    quantiles = ordered[np.linspace(0, len(ordered) - 1, _QUANTILES).round().astype(int)]
    share = np.diff(quantiles) ** (2 / 3)
    for _ in range(_CAPPINGS):  # a few distant values need few levels
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
        levels = np.maximum.accumulate(moved)  # rounded sums may swap neighbours
    levels = levels.astype(np.float32)
    middles = (levels[1:].astype(np.float64) + levels[:-1]) / 2
    return levels, np.searchsorted(middles, values).astype(np.uint8)


def palette_for(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Quantise ``rows`` (N, D) float32 to a palette of at most ``count`` entries.

    Returns the palette (P, D) and the index (N,) of the entry of each row.

    Computing N · P distances would take minutes, so the clustering has two levels: first, the rows
    are divided into about √count clusters; then each cluster gets a number of palette entries that
    is proportional to its size.
    """
    if len(rows) <= count:
        return rows, np.arange(len(rows))
    random = np.random.default_rng(0)
    sample = rows if len(rows) <= _SAMPLE else rows[_choose(random, len(rows), _SAMPLE)]
    coarse = _kmeans(sample, max(1, round(count**0.5)), random)
    cluster = _nearest(rows, coarse)
    order = np.argsort(cluster, kind="stable")
    ends = np.cumsum(np.bincount(cluster, minlength=len(coarse)))
    # Each cluster has at least one entry. The remaining ones are divided by rounding a cumulative
    # sum, so that the total is exactly the count.
    sizes = np.diff(ends, prepend=0)
    spare = count - np.count_nonzero(sizes)
    shares = (sizes > 0) + np.diff(np.rint(ends / len(rows) * spare).astype(int), prepend=0)
    parts, labels, start = [], np.empty(len(rows), np.int64), 0
    for members, share in zip(np.split(order, ends[:-1]), shares, strict=True):
        if not len(members):
            continue
        entries = _kmeans(rows[members], share, random)
        labels[members] = start + _nearest(rows[members], entries)
        parts.append(entries)
        start += len(entries)
    return np.concatenate(parts), labels


def _kmeans(rows: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """At most ``count`` cluster centres (C, D) of the rows, by a few Lloyd iterations."""
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
    """(N,) index of the nearest centre, computed in chunks to bound the memory."""
    # The products of NumPy use all processors, for matrices that are too small for it. Those of
    # torch use as many threads as the caller has set.
    import torch

    half_norms = torch.from_numpy(0.5 * (centres * centres).sum(1))
    transposed = torch.from_numpy(np.ascontiguousarray(centres.T))
    label = np.empty(len(rows), np.int64)
    step = max(1, _CHUNK // len(centres))
    for start in range(0, len(rows), step):
        part = torch.from_numpy(np.ascontiguousarray(rows[start : start + step]))
        scores = torch.addmm(half_norms, part, transposed, beta=-1)
        label[start : start + step] = scores.argmax(1).numpy()
    return label


def _choose(random: np.random.Generator, total: int, count: int) -> np.ndarray:
    return np.sort(random.choice(total, count, replace=False))
