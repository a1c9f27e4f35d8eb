"""The matches of long tracks, with which a model is made first."""

import numpy as np

from snowsplat.sfm.colmap.mapping.tracks import of_long_tracks


def matches_of(tracks):
    """All matches between the features (photo, index) of each of ``tracks``."""
    found = {}
    for track in tracks:
        for one in track:
            for other in track:
                if one[0] < other[0]:
                    found.setdefault((one[0], other[0]), []).append((one[1], other[1]))
    return [(*pair, np.array(rows)) for pair, rows in sorted(found.items())]


def chosen(matches, counts, kept):
    masks = of_long_tracks(matches, counts, 0.0, kept)
    return {
        (i, j): [tuple(row) for row in rows[mask].tolist()]
        for (i, j, rows), mask in zip(matches, masks, strict=True)
    }


def test_the_longest_tracks_of_each_pair_are_kept_in_all_pairs():
    long = [(1, 5), (2, 4), (3, 0)]
    short, weak = [(1, 6), (2, 7)], [(3, 9), (4, 1)]
    matches = matches_of([short, long, weak])
    counts = dict.fromkeys((1, 2, 3, 4), 10)
    assert chosen(matches, counts, 1) == {
        (1, 2): [(5, 4)],
        (1, 3): [(5, 0)],
        (2, 3): [(4, 0)],
        (3, 4): [(9, 1)],  # the longest track of this pair
    }
    assert chosen(matches, counts, 2)[1, 2] == [(6, 7), (5, 4)]


def test_a_track_with_several_features_in_a_photo_comes_last():
    repeated = [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 3)]
    matches = matches_of([repeated, [(1, 7), (2, 7)]])
    assert chosen(matches, dict.fromkeys((1, 2, 3), 10), 1)[1, 2] == [(7, 7)]


def test_each_pair_keeps_enough_matches_and_the_tracks_stay_whole():
    generator = np.random.default_rng(0)
    counts = dict.fromkeys(range(1, 8), 80)
    matches = []
    for i in counts:
        for j in range(i + 1, 8):
            number = int(generator.integers(0, 60))
            rows = [generator.permutation(80)[:number] for _ in range(2)]
            matches.append((i, j, np.stack(rows, 1)))
    masks = of_long_tracks(matches, counts, 0.3, 20)
    assert all(mask.sum() >= min(max(20, 0.3 * len(mask)), len(mask)) for mask in masks)
    ends = {True: set(), False: set()}
    for (i, j, rows), mask in zip(matches, masks, strict=True):
        for (a, b), keep in zip(rows.tolist(), mask, strict=True):
            ends[bool(keep)] |= {(i, a), (j, b)}
    assert not ends[True] & ends[False]  # no feature is in a chosen track and in another one


def test_no_matches():
    assert of_long_tracks([], {1: 3}) == []
    (mask,) = of_long_tracks([(1, 2, np.zeros((0, 2), np.uint32))], {1: 3, 2: 0})
    assert mask.shape == (0,)
