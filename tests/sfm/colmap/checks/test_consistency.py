"""Which photos contradict the others, from verified matches and shared points."""

import itertools
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from snowsplat.scene.epipolar import distances_of_matches
from snowsplat.sfm.colmap.checks.consistency import CheckedPair, agreement_of
from snowsplat.sfm.colmap.checks.parts import find_parts


def chain(photos, share=0.7, matches=400, neighbours=3):
    """Pairs of each photo with the next ones; ``share`` of their matches are hits."""
    return [
        CheckedPair(i, j, matches, round(share * matches))
        for i, j in itertools.combinations(photos, 2)
        if photos.index(j) - photos.index(i) <= neighbours
    ]


def folded():
    """Photos 1 … 20 and 21 … 30: tears between the parts, and confirmed pairs with few matches.

    The confirmed pairs are look-alikes.
    """
    pairs = chain(range(1, 21)) + chain(range(21, 31))
    pairs += [CheckedPair(i, j, 900, 20) for i in (18, 19, 20) for j in (21, 22, 23)]
    return pairs + [CheckedPair(i, i + 20, 90, 60) for i in range(1, 11)]


def test_a_model_without_contradictions_is_one_part():
    assert find_parts(chain(range(1, 31))) == [set(range(1, 31))]
    assert find_parts([]) == []


def test_a_folded_part_is_cut_off():
    assert find_parts(folded()) == [set(range(1, 21)), set(range(21, 31))]


def test_the_order_of_the_pairs_does_not_matter():
    pairs = folded()
    np.random.default_rng(0).shuffle(pairs)
    assert find_parts(pairs) == find_parts(folded())


def test_a_long_part_with_many_weak_links_is_cut_off():
    """Two walks of 300 and 200 photos, with tears where the second walk begins.

    199 false pairs with few matches agree with the model.
    """

    def near(photos):
        return [
            CheckedPair(i, j, 2400 // (j - i), 1700 // (j - i))
            for i, j in itertools.combinations(photos, 2)
            if j - i <= 12
        ]

    pairs = near(range(1, 301)) + near(range(301, 501))
    pairs += [
        CheckedPair(300 - a, 301 + b, 2400 // (a + b + 1), 5) for a in range(6) for b in range(6)
    ]
    pairs += [CheckedPair(i, i + 300, 150, 100) for i in range(1, 200)]
    assert find_parts(pairs) == [set(range(1, 301)), set(range(301, 501))]


def test_several_parts_are_cut_off():
    pairs = chain(range(1, 21)) + chain(range(21, 31)) + chain(range(31, 39))
    for one, other in ((20, 21), (30, 31), (12, 36)):
        pairs += [CheckedPair(one - a, other + b, 900, 0) for a in range(3) for b in range(3)]
    pairs += [CheckedPair(i, i + 20, 90, 60) for i in range(1, 11)]
    pairs += [CheckedPair(i, i + 30, 90, 60) for i in range(1, 9)]
    assert find_parts(pairs) == [set(range(1, 21)), set(range(21, 31)), set(range(31, 39))]


def test_a_single_photo_is_cut_off():
    pairs = chain([i for i in range(1, 31) if i != 15])
    pairs += [CheckedPair(*sorted((15, i)), 400, 8) for i in (12, 13, 14, 16, 17, 18)]
    assert find_parts(pairs) == [set(range(1, 31)) - {15}, {15}]


def test_photos_that_follow_each_other_outweigh_look_alikes():
    """A walk with weak true matches in the middle.

    Look-alikes have nearly as many matches. This occurs in bonsai_photos: the photos 5763 and 5764
    have true matches, and the photos 5750 and 5845 have nearly as many false matches.
    """

    border = [(20, 21, 500), (19, 21, 200), (20, 22, 200)]
    true = [CheckedPair(i, j, matches, 150, follows=True) for i, j, matches in border]
    false = [CheckedPair(i, j, 350, 0) for i in (8, 9, 10) for j in (28, 29, 30)]
    pairs = chain(range(1, 21)) + chain(range(21, 41)) + true + false
    assert find_parts(pairs) == [set(range(1, 41))]


def test_photos_that_follow_each_other_outweigh_two_equal_rooms():
    """A walk through two equal rooms. In the model they are one room, with tears at the door."""

    def pairs(in_order):
        door = [(20, 21, 400), (19, 21, 200), (20, 22, 200)]
        true = chain(range(1, 21)) + chain(range(21, 41)) + [CheckedPair(*p, 0) for p in door]
        true = [replace(p, follows=in_order and p.second - p.first <= 2) for p in true]
        false = [CheckedPair(i, i + 20, 900, 700) for i in range(1, 21)]
        return [*true, *false, *(CheckedPair(i, i + 21, 700, 500) for i in range(1, 20))]

    assert find_parts(pairs(in_order=False)) == [set(range(1, 41))]
    assert find_parts(pairs(in_order=True)) == [set(range(1, 21)), set(range(21, 41))]


def test_a_few_matches_suffice_if_photos_follow_each_other():
    """A walk around two equal objects. While the camera turns, photos have few matches."""

    def pairs(border):
        between = [CheckedPair(i, j, n, 0, follows=True) for i, j, n in border]
        true = chain(range(1, 21)) + chain(range(21, 41))
        true = [replace(p, follows=p.second - p.first <= 2) for p in true]
        return [*true, *between, *(CheckedPair(i, i + 20, 900, 700) for i in range(1, 21))]

    assert find_parts(pairs([(20, 21, 54), (19, 21, 24)])) == [
        set(range(1, 21)),
        set(range(21, 41)),
    ]
    assert find_parts(pairs([(20, 21, 54), (19, 21, 14)])) == [set(range(1, 41))]
    assert find_parts(pairs([(20, 21, 54)])) == [set(range(1, 41))]


def test_look_alikes_in_a_correct_model_cut_nothing():
    """Two places with false matches; the model confirms all pairs on the way between the places."""
    pairs = chain(range(1, 31))
    pairs += [CheckedPair(i, j, 300, 0) for i in range(1, 6) for j in range(26, 31)]
    assert find_parts(pairs) == [set(range(1, 31))]


def test_tears_of_every_second_photo_cut_nothing():
    """A floor with a pattern: of the matches of every second photo, most are false."""
    pairs = [CheckedPair(i, i + 1, 500, 450, follows=True) for i in range(1, 30)]
    pairs += [CheckedPair(i, i + 2, 400, 350, follows=True) for i in range(1, 14)]
    pairs += [CheckedPair(i, i + 2, 600, 10, follows=True) for i in range(14, 29)]
    pairs += [CheckedPair(i, i + 3, 500, 0) for i in range(1, 28)]
    assert find_parts(pairs) == [set(range(1, 31))]
    # Where the walk is torn, the pairs across the tear still count.
    broken = [replace(p, hits=0) if (p.first, p.second) == (20, 21) else p for p in pairs]
    assert find_parts(broken) == [set(range(1, 21)), set(range(21, 31))]


def test_little_evidence_cuts_nothing():
    """Two tears, or pairs with few matches, are not enough."""
    two = [CheckedPair(10, 11, 900, 0), CheckedPair(9, 12, 900, 0)]
    assert len(find_parts(chain(range(1, 11)) + chain(range(11, 16)) + two)) == 1
    weak = [CheckedPair(i, j, 49, 0) for i in range(1, 11) for j in range(11, 16)]
    assert len(find_parts(chain(range(1, 11)) + chain(range(11, 16)) + weak)) == 1


def test_matches_that_agree_with_the_poses_are_no_tears():
    """The surfaces are too far away, so the model has no points for these matches."""
    pairs = [
        CheckedPair(p.first, p.second, p.matches, p.hits, 0.9 if p.hit_share < 0.1 else 0.0)
        for p in folded()
    ]
    assert len(find_parts(pairs)) == 1


@pytest.mark.parametrize(
    ("hits", "misses", "agreeing", "support"),
    [
        (0.9, 0.0, 1.0, 1.0),
        (0.06, 0.0, 0.0, 1.0),  # the other matches have no points
        (0.3, 0.1, 0.9, 0.75),
        (0.1, 0.3, 0.9, 0.25),
        (0.0, 0.4, 1.0, 0.0),  # poses at a wrong distance agree with the matches
        (0.02, 0.02, 0.6, 1.0),  # hardly any points, so the poses decide
        (0.02, 0.02, 0.4, 0.0),
    ],
)
def test_support_of_a_pair(hits, misses, agreeing, support):
    pair = CheckedPair(1, 2, 1000, round(1000 * hits), agreeing, misses)
    assert pair.support == pytest.approx(support)
    assert pair.torn == (support < 0.3)


def test_which_matches_agree_with_their_pose():
    random = np.random.default_rng(3)
    axis = np.array([0.1, 0.25, -0.05])
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(axis), np.array([1.0, 0.2, 0.1]))
    points = random.uniform([-3, -3, 4], [3, 3, 9], (200, 3))
    rotation = pose.rotation.matrix()

    def agreeing(pose, others, error=1e-3):
        rays = (xyz[:, :2] / xyz[:, 2:] for xyz in (points, others))
        distances = distances_of_matches(pose.rotation.matrix(), pose.translation, *rays)
        return np.mean(distances <= error)

    seen = points @ rotation.T + pose.translation
    assert agreeing(pose, seen, 1e-9) == 1
    # Behind the cameras, and of another pose.
    assert agreeing(pycolmap.Rigid3d(pose.rotation, -pose.translation), seen) < 0.1
    turn = pycolmap.Rotation3d(np.array([0, np.radians(20), 0]))
    assert agreeing(pycolmap.Rigid3d(turn * pose.rotation, pose.translation), seen) < 0.1
    # If the camera only turns, the rays are parallel, so there are no points.
    moved = pycolmap.Rigid3d(pose.rotation, np.array([0.01, 0, 0]))
    assert agreeing(moved, points @ rotation.T) == 1


def test_agreement_of_a_model_is_that_of_the_worst_of_the_strongest_pairs():
    """Pairs of photos that look alike have fewer matches, which may be false."""
    right = [CheckedPair(i, i + 1, 300, 250, agreeing=1.0) for i in range(1, 99)]
    false = [CheckedPair(1, i, 200, 0, agreeing=0.0) for i in range(4, 99)]
    assert agreement_of(right + false) == 1.0
    bent = [replace(pair, agreeing=0.8) if pair.first < 3 else pair for pair in right]
    assert agreement_of(bent + false) == pytest.approx((2 * 0.8 + 3) / 5)
    assert agreement_of(bent[:5]) == pytest.approx((2 * 0.8 + 1) / 3)
    assert agreement_of([]) == 0.0
    few = [CheckedPair(i, i + 1, 15, 9, follows=True, agreeing=0.6) for i in range(1, 99)]
    assert agreement_of(right + few) == 1.0
    assert agreement_of(few) == pytest.approx(0.6)


def test_misses_do_not_count():
    """On repeating structures, some of the matches of neighbouring photos are false."""
    pairs = [CheckedPair(i, i + 1, 300, 200, agreeing=0.7) for i in range(1, 9)]
    assert agreement_of(pairs) == pytest.approx(0.7)
    missed = [replace(pair, miss_share=0.28) for pair in pairs]
    assert agreement_of(missed) == pytest.approx(0.7 / 0.72)
    assert agreement_of([replace(pair, miss_share=0.4) for pair in pairs]) == 1.0
