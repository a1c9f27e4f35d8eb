"""The pairs that are matched, for each kind of input."""

import dataclasses

import numpy as np
import pytest

from snowsplat.sfm.colmap.database import VerifiedPair
from snowsplat.sfm.colmap.options import EFFORTS
from snowsplat.sfm.colmap.pairs.choice import choose_pairs
from snowsplat.sfm.ingest.photo import Photo

EFFORT = EFFORTS["normal"]


def photo(number, sequence=None, location=None):
    name = f"{sequence or 'photo'}/{number:04}.jpg"
    return Photo(name, name, 640, 480, "phone", sequence, location=location)


def not_needed():
    raise AssertionError("retrieval is not needed here")


def ring(count, places):
    """Similarity of photos at positions on a ring of ``places``: the nearer, the more similar."""
    angles = 2 * np.pi * np.arange(count) / places
    return np.cos(angles[:, None] - angles[None])


def test_all_pairs_of_few_photos_are_matched():
    choice = choose_pairs([photo(i) for i in range(20)], EFFORT, not_needed)
    assert len(choice.pairs) == len(set(choice.pairs)) == 190
    assert "all pairs" in choice.description


def test_frames_are_matched_with_following_ones_in_growing_steps():
    count = 400
    photos = [photo(i, "walk.mp4") for i in range(count)]
    chosen = set(choose_pairs(photos, EFFORT, lambda: np.eye(count)).pairs)
    steps = {j - i for i, j in chosen if i == 100}
    assert set(range(1, EFFORT.overlap + 1)) <= steps
    assert {20, 40, 80, 160} <= steps
    assert len(chosen) < 40 * count


def test_loop_of_a_video_is_closed():
    """The camera returns to its starting point: the first frames are matched with the last."""
    count = 300
    photos = [photo(i, "walk.mp4") for i in range(count)]
    chosen = set(choose_pairs(photos, EFFORT, lambda: ring(count, count)).pairs)
    assert {(0, 299), (1, 299), (0, 298)} <= chosen


def test_photos_with_gps_are_matched_with_the_nearest():
    """Two streets 500 m apart; one degree of latitude is 111 km."""
    photos = [
        photo(i, location=(52 + street * 500 / 111_320 + 1e-6 * i, 4 + i * 5e-5, 0))
        for street in (0, 1)
        for i in range(100)
    ]
    chosen = set(choose_pairs(photos, EFFORT, lambda: ring(200, 200)).pairs)
    assert all((i, i + 1) in chosen for i in range(99))
    near = sum((i < 100) == (j < 100) for i, j in chosen)
    assert near > 0.6 * len(chosen)


@pytest.mark.parametrize("error", [0.0, 4.0])
def test_positions_that_do_not_differ_choose_no_pairs(error):
    """Indoors, phones store the last position, or positions with an error of metres."""
    noise = np.random.default_rng(0).normal(0, error / 111_320, (200, 2))
    places = [(52.0 + north, 4.0 + east, 500.0) for north, east in noise]
    located = choose_pairs(
        [photo(i, location=place) for i, place in enumerate(places)], EFFORT, lambda: ring(200, 200)
    )
    without = choose_pairs([photo(i) for i in range(200)], EFFORT, lambda: ring(200, 200))
    if error == 0.0:
        assert located == without
    assert set(without.pairs) <= set(located.pairs)


def test_photos_at_a_stored_position_need_similar_photos():
    """Half of the photos were taken along a street, the others in a house at its end."""
    places = [(52.0, 4.0 + 1e-4 * max(0, i - 100), 0.0) for i in range(200)]
    photos = [photo(i, location=place) for i, place in enumerate(places)]
    similar = ring(200, 200)
    chosen = set(choose_pairs(photos, EFFORT, lambda: similar).whole().pairs)
    assert all((i, i + step) in chosen for i in range(80) for step in range(1, 11))


def test_many_photos_are_matched_with_similar_ones():
    count = 200
    choice = choose_pairs([photo(i) for i in range(count)], EFFORT, lambda: ring(count, count))
    assert set(range(47, 54)) - {50} <= partners(choice.pairs, 50)  # the most similar ones
    assert max(partners(choice.pairs, 50)) >= 59  # and some at a distance
    assert len(choice.pairs) < 12 * count
    assert choice.pairs == sorted(set(choice.pairs))
    assert "similar" in choice.description
    assert f"{len(choice.pairs)} pairs" in choice.description
    every = choice.whole()
    assert partners(every.pairs, 50) >= set(range(40, 61)) - {50}
    assert len(every.pairs) == len(choice.pairs) + len(choice.reserve)
    assert not every.reserve


def partners(pairs, photo):
    return {j for i, j in pairs if i == photo} | {i for i, j in pairs if j == photo}


def test_the_reserve_is_for_photos_with_few_matches():
    photos = [photo(i) for i in range(200)]
    choice = choose_pairs(photos, EFFORT, lambda: ring(200, 200))
    clear = [VerifiedPair(i + 1, j + 1, 200) for i, j in choice.pairs]
    assert choice.complete(clear, 200).pairs == choice.pairs
    weak = [dataclasses.replace(p, matches=20) if 51 in (p.first, p.second) else p for p in clear]
    completed = choice.complete(weak, 200).pairs
    assert partners(completed, 50) == partners(choice.whole().pairs, 50)
    assert set(completed) - set(choice.pairs) == {pair for pair in choice.reserve if 50 in pair}


def test_the_whole_reserve_is_needed_between_two_groups():
    photos = [photo(i) for i in range(200)]
    choice = choose_pairs(photos, EFFORT, lambda: ring(200, 200))
    within = [VerifiedPair(i + 1, j + 1, 200) for i, j in choice.pairs if (i < 100) == (j < 100)]
    assert choice.complete(within, 200).pairs == choice.whole().pairs


def test_numbered_photos_are_matched_with_the_next_photos_by_name():
    """The order is that of the numbers, not of the text, and each prefix is a series of its own."""
    names = [f"walk/IMG_{i}.JPG" for i in range(2, 102)] + [f"other{i}.png" for i in range(100)]
    photos = [Photo(name, name, 640, 480, "phone") for name in names]
    unlike = np.random.default_rng(0).random((200, 200))
    choice = choose_pairs(photos, EFFORT, lambda: unlike)
    chosen, overlap = set(choice.pairs), EFFORT.overlap // 2
    assert all((i, i + step) in chosen for i in range(90) for step in range(1, overlap + 1))
    assert all((i, i + 1) in chosen for i in range(100, 199))
    assert "next photos by name" in choice.description
    assert len(choice.pairs) <= 200 * (EFFORT.neighbours + overlap)


def test_photos_without_numbers_are_matched_with_similar_ones_only():
    names = [f"{a}{b}.jpg" for a in "abcdefghijklmnopqrst" for b in "abcdefghij"]
    photos = [Photo(name, name, 640, 480, "phone") for name in names]
    choice = choose_pairs(photos, EFFORT, lambda: ring(200, 200))
    assert "by name" not in choice.description


def test_two_videos_and_photos_are_connected():
    photos = (
        [photo(i, "a.mp4") for i in range(60)]
        + [photo(i, "b.mp4") for i in range(60)]
        + [photo(i) for i in range(10)]
    )
    chosen = choose_pairs(photos, EFFORT, lambda: ring(130, 65)).pairs
    kinds = {tuple(sorted((photos[i].sequence or "", photos[j].sequence or ""))) for i, j in chosen}
    assert {("a.mp4", "b.mp4"), ("", "a.mp4"), ("", "b.mp4"), ("a.mp4", "a.mp4")} <= kinds


@pytest.mark.parametrize("effort", EFFORTS.values(), ids=EFFORTS)
def test_a_stronger_effort_matches_more_pairs(effort):
    photos = [photo(i) for i in range(300)]
    few = choose_pairs(photos, effort, lambda: ring(300, 300)).pairs
    assert len(choose_pairs(photos, effort.stronger(), lambda: ring(300, 300)).pairs) > len(few)
