"""The view graph: weights of pairs, photos that follow each other, and parts of the graph."""

import pytest

from snowsplat.sfm.colmap.mapping.view_graph import VerifiedPair, ViewGraph, following_pairs

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
    graph = ViewGraph.from_pairs(NAMES, [(2, 3, 80), (1, 2, 90), (1, 9, 70), (1, 5, 60)])
    found = [(pair.first, pair.second, pair.matches, pair.follows) for pair in graph.pairs]
    assert found == [(1, 2, 90, True), (1, 5, 60, False), (2, 3, 80, True)]
    assert [pair.other(2) for pair in graph.pairs_of[2]] == [3, 1]
    assert graph.pairs_of[6] == []


def test_a_part_of_the_photos_has_its_own_order():
    graph = ViewGraph.from_pairs(NAMES, [(1, 2, 90), (1, 5, 60), (5, 6, 70)])
    (pair,) = graph.of_photos([1, 3, 5]).pairs
    assert (pair.first, pair.second, pair.matches, pair.follows) == (1, 5, 60, True)
    assert list(graph.of_photos([1, 3, 5]).names) == [1, 3, 5]


def test_the_matrix_is_symmetric():
    ids, matches = ViewGraph.from_pairs({4: "x", 2: "y", 9: "z"}, [(2, 9, 30), (2, 4, 5)]).matrix()
    assert ids == [2, 4, 9]
    assert matches.tolist() == [[0, 5, 30], [5, 0, 0], [30, 0, 0]]


@pytest.mark.parametrize("names", [{}, {1: "only.jpg"}])
def test_a_graph_without_pairs(names):
    graph = ViewGraph.from_pairs(names, [])
    assert graph.pairs == []
    assert graph.matrix()[1].shape == (len(names), len(names))
