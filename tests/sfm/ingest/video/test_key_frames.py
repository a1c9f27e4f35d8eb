"""The choice of frames by the motion between them, in sequences of numbers."""

import numpy as np
import pytest

from snowsplat.sfm.ingest.video.key_frames import Candidate, choose


def candidates(places, sharpness=None):
    values = np.ones(len(places)) if sharpness is None else sharpness
    pairs = zip(places, values, strict=True)
    return [Candidate(float(p), float(s), i) for i, (p, s) in enumerate(pairs, 1)]


def uneven(seed=0, count=300):
    """Places with still, slow and fast parts."""
    random = np.random.default_rng(seed)
    speed = np.repeat(random.choice([0.0005, 0.01, 0.05], count // 20), 20)
    return np.cumsum(speed * random.uniform(0.5, 1.5, len(speed)))


def steps(chosen):
    return np.diff([candidate.moved for candidate in chosen])


def test_all_candidates_are_kept_if_there_are_few():
    every = candidates([0, 0, 1])
    assert choose(every, 3) == every
    assert choose([], 3) == []


@pytest.mark.parametrize("most", [1, 2, 7, 60, 299])
@pytest.mark.parametrize("seed", range(4))
def test_at_most_the_requested_number_in_order(most, seed):
    chosen = choose(candidates(uneven(seed)), most)
    assert 1 <= len(chosen) <= most
    numbers = [candidate.number for candidate in chosen]
    assert numbers == sorted(set(numbers))


def test_steps_are_even():
    chosen = choose(candidates(uneven()), 40)
    assert len(chosen) == 40
    assert steps(chosen).max() < 1.6 * np.median(steps(chosen))


@pytest.mark.parametrize("seed", range(6))
def test_no_step_is_longer_than_necessary(seed):
    """The longest step is at most twice the best possible one, found by trying all steps."""
    places = uneven(seed, 60)
    chosen = choose(candidates(places, np.random.default_rng(seed).uniform(1, 2, 60)), 12)

    def needed(step):  # each time the farthest candidate within the step
        count, place = 1, places[0]
        while place < places[-1]:
            within = places[(places > place) & (places <= place + step + 1e-12)]
            place = within[-1] if len(within) else places[places > place][0]
            count += 1
        return count

    lengths = {b - a for i, a in enumerate(places) for b in places[i + 1 :]}
    best = min(length for length in lengths if needed(length) <= 12)
    assert steps(chosen).max() <= 2 * best


def test_the_sharpest_near_each_moment():
    sharpness = [1, 1, 3, 1, 1, 2, 1, 1, 2, 1, 1, 2]
    chosen = choose(candidates(range(12), sharpness), 4)
    assert [candidate.number for candidate in chosen] == [3, 6, 9, 12]


def test_the_longest_steps_are_divided_until_all_frames_are_used():
    chosen = choose(candidates(range(24)), 10)  # steps of 2 need 12 frames, steps of 3 need 8
    assert len(chosen) == 10
    assert steps(chosen).max() <= 3


def test_frames_at_one_place():
    assert len(choose(candidates(np.zeros(9)), 4)) == 1
