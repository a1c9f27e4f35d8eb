"""Groups of pairs for verification."""

import itertools

from snowsplat.sfm.colmap.pair_matching import _by_inlier_ratio


def test_each_pair_is_verified_with_the_largest_ratio_that_cannot_lose_it():
    counts = {(0, 1): 15, (0, 2): 18, (0, 3): 30, (1, 2): 47, (1, 3): 5000, (2, 3): 4}
    pairs = [*counts, (3, 4)]  # a pair without a row in the table of matches
    groups = _by_inlier_ratio(pairs, counts)
    assert sorted(itertools.chain(*groups.values())) == sorted(pairs)
    ratio = {pair: ratio for ratio, group in groups.items() for pair in group}
    assert [ratio[pair] for pair in pairs] == [0.9, 0.8, 0.5, 0.25, 0.25, 0.9, 0.9]
    assert all(ratio[pair] * count <= 15 or ratio[pair] == 0.25 for pair, count in counts.items())
