"""The view graph: weights of pairs, photos that follow each other, parts, and a spread subset."""

import itertools

import numpy as np
import pytest

from snowsplat.sfm.colmap.database import VerifiedPair
from snowsplat.sfm.colmap.mapping.view_graph import ViewGraph, following_pairs, spread_subset


def graph_of(names, pairs):
    return ViewGraph.from_pairs(names, [VerifiedPair(*pair) for pair in pairs])


NAMES = {i: f"IMG_{10 + i}.jpg" for i in range(1, 7)}


def test_photos_that_follow_each_other_count_more():
    assert VerifiedPair(1, 2, 30, follows=True).weight == 20 * VerifiedPair(1, 5, 30).weight
    assert VerifiedPair(1, 2, 15, follows=True).counts
    assert not VerifiedPair(1, 2, 14, follows=True).counts
    assert VerifiedPair(1, 5, 50).counts
    assert not VerifiedPair(1, 5, 49).counts


def test_photos_follow_each_other_if_at_most_one_photo_is_between_them():
    found = following_pairs({7: "a2.jpg", 3: "a9.jpg", 5: "a10.jpg", 4: "a33.jpg", 1: "b3.jpg"})
    assert found == {(3, 7), (3, 5), (4, 5), (5, 7), (3, 4)}


def test_the_pairs_of_a_graph_are_those_between_its_photos():
    graph = graph_of(NAMES, [(2, 3, 80), (1, 2, 90), (1, 9, 70), (1, 5, 60)])
    found = [(pair.first, pair.second, pair.matches, pair.follows) for pair in graph.pairs]
    assert found == [(1, 2, 90, True), (1, 5, 60, False), (2, 3, 80, True)]
    assert [pair.other(2) for pair in graph.pairs_of[2]] == [3, 1]
    assert graph.pairs_of[6] == []


def test_a_part_of_the_photos_has_its_own_order():
    graph = graph_of(NAMES, [(1, 2, 90), (1, 5, 60), (5, 6, 70)])
    (pair,) = graph.of_photos([1, 3, 5]).pairs
    assert (pair.first, pair.second, pair.matches, pair.follows) == (1, 5, 60, True)
    assert list(graph.of_photos([1, 3, 5]).names) == [1, 3, 5]


def test_the_matrix_is_symmetric():
    ids, matches = graph_of({4: "x", 2: "y", 9: "z"}, [(2, 9, 30), (2, 4, 5)]).matrix()
    assert ids == [2, 4, 9]
    assert matches.tolist() == [[0, 5, 30], [5, 0, 0], [30, 0, 0]]


@pytest.mark.parametrize("names", [{}, {1: "only.jpg"}])
def test_a_graph_without_pairs(names):
    graph = graph_of(names, [])
    assert graph.pairs == []
    assert graph.matrix()[1].shape == (len(names), len(names))


# A subset

COUNT = 40


def walk(matches, named=True, weak=()):
    """Photos along a line, with ``matches[d - 1]`` matches between photos at distance d.

    After each photo of ``weak``, the view changes: there are 40 matches between the two sides.
    """
    names = {i: f"{i:03}.jpg" if named else f"{chr(65 + i)}.jpg" for i in range(1, COUNT + 1)}
    pairs = [
        (i, i + d, 40 if any(i <= w < i + d for w in weak) else number)
        for d, number in enumerate(matches, start=1)
        for i in range(1, COUNT + 1 - d)
    ]
    return graph_of(names, pairs)


def test_the_photos_are_spread():
    subset = sorted(spread_subset(walk([900, 700, 500, 300, 200, 150]), COUNT // 2))
    assert len(subset) == COUNT // 2
    steps = [b - a for a, b in itertools.pairwise(subset)]
    assert max(steps) <= 4
    assert {1, COUNT} <= set(subset)


def test_photos_without_numbers_are_spread_by_their_matches():
    subset = sorted(spread_subset(walk([900, 700, 500, 300, 200, 150], named=False), COUNT // 3))
    assert len(subset) == COUNT // 3
    steps = [b - a for a, b in itertools.pairwise(subset)]
    assert max(steps) <= 6


def test_photos_that_connect_the_others_stay():
    """Of three photos of the subset in a row, the first and the last one are a strong pair."""
    subset = sorted(spread_subset(walk([900, 400, 150, 60]), 2))
    assert len(subset) < COUNT
    assert max(b - a for a, b in zip(subset, subset[2:], strict=False)) == 3


def test_the_photos_on_both_sides_of_a_weak_link_stay():
    """The camera turns fast after photo 20, where even neighbours have few matches."""
    subset = spread_subset(walk([900, 700, 500, 300, 200, 150], weak=[20]), COUNT // 3)
    assert {20, 21} <= subset


def test_nothing_is_left_out_without_strong_pairs():
    assert spread_subset(walk([90, 80, 70]), 5) == set(range(1, COUNT + 1))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_very_few_photos(count):
    graph = graph_of({i: f"{i}.jpg" for i in range(count)}, [])
    assert spread_subset(graph, count) == set(range(count))


def test_photos_left_out_at_once_or_one_by_one_are_the_same():
    """So the values that are kept from one photo to the next are correct."""
    random = np.random.default_rng(0)
    steps = [*range(1, 7), *range(13, 18)]  # the camera passes a place again after 15 photos
    pairs = [
        (i, i + step, int(random.integers(50, 900)))
        for step in steps
        for i in range(1, COUNT + 1 - step)
    ]
    graph = graph_of(walk([], named=False).names, pairs)
    left = set(graph.names)
    for _ in range(COUNT):
        left = spread_subset(graph.of_photos(left), len(left) - 1)
    assert len(left) < COUNT // 2
    assert spread_subset(graph, 1) == left


def test_no_long_gaps_in_a_series():
    """Photos far apart by name have many matches, too: two rooms look alike."""
    pairs = [(i, j, 200 + i + j) for i in range(1, 41) for j in range(i + 1, 41)]
    graph = graph_of({i: f"{i:03}.jpg" for i in range(1, 41)}, pairs)
    subset = sorted(spread_subset(graph, 5))
    assert max(b - a for a, b in itertools.pairwise(subset)) == 4
    assert {1, 40} <= set(subset)
