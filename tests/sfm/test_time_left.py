"""The estimate of the time until structure from motion is finished, with simulated clocks."""

import itertools

import pytest

from snowsplat.sfm import time_left
from snowsplat.sfm.cost import Photos, Step, share_of_poses, steps_of
from snowsplat.sfm.time_left import Later, SfmTimeLeft, TimeLeft

STEPS = {"features": Step(60.0), "verified": Step(30.0), "poses": Step(100.0, 1)}


class Clock:
    """Simulates a machine; `work` finishes work of a step and tells `left` about it."""

    def __init__(self, slowness: float, cores: float, threads: int = 4) -> None:
        self.now = self.cpu = 0.0
        self.slowness, self.cores = slowness, cores
        self.left = TimeLeft(STEPS, threads, lambda: self.now, lambda: self.cpu)

    def seconds(self, step: str, share: float = 1.0, slower: float = 1.0) -> float:
        """The true seconds for a share of a step."""
        work = share * STEPS[step].work * self.slowness * slower
        return work / min(STEPS[step].threads, self.cores)

    def work(self, step: str, begin: float, end: float, slower: float = 1.0) -> None:
        parts = 20
        self.left.update(step, begin)
        for i in range(1, parts + 1):
            seconds = self.seconds(step, (end - begin) / parts, slower)
            self.now += seconds
            self.cpu += seconds * min(STEPS[step].threads, self.cores)
            self.left.update(step, begin + (end - begin) * i / parts)


@pytest.mark.parametrize("slowness", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("cores", [0.6, 2.0, 4.0])
def test_the_speed_and_the_load_of_the_machine_are_found_in_the_first_step(slowness, cores):
    clock = Clock(slowness, cores)
    clock.work("features", 0.0, 0.5)
    rest = clock.seconds("features", 0.5) + clock.seconds("verified") + clock.seconds("poses")
    assert clock.left.seconds == pytest.approx(rest, rel=0.2)


def test_a_step_that_is_slower_than_predicted_does_not_affect_the_others():
    clock = Clock(1.0, 2.0)
    clock.work("features", 0.0, 1.0)
    clock.work("verified", 0.0, 0.5, slower=3.0)
    rest = clock.seconds("verified", 0.5, slower=3.0) + clock.seconds("poses")
    assert clock.left.seconds == pytest.approx(rest, rel=0.1)


def test_a_repeated_step_takes_as_long_as_before():
    clock = Clock(1.0, 2.0)
    for step in ("features", "verified"):
        clock.work(step, 0.0, 1.0)
    clock.work("poses", 0.0, 0.9, slower=2.0)
    clock.left.update("poses", 0.5)
    assert clock.left.seconds == pytest.approx(clock.seconds("poses", 0.5, 2.0), rel=0.1)


def test_the_time_left_decreases_while_nothing_is_reported_and_never_ends_before_the_job():
    clock = Clock(1.0, 2.0)
    for step in ("features", "verified"):
        clock.work(step, 0.0, 1.0)
    clock.work("poses", 0.0, 0.9)
    before = clock.left.seconds
    clock.now += 5.0
    assert clock.left.seconds == pytest.approx(before - 5.0)
    clock.now += 20.0
    assert clock.left.seconds == pytest.approx(0.25 * 25.0)


def test_the_first_photos_of_many_take_longer():
    """They are registered with bundle adjustment."""
    shares = [share_of_poses(n, 300) for n in range(301)]
    each = [b - a for a, b in itertools.pairwise(shares)]
    assert each[:120] == pytest.approx([each[0]] * 120)
    assert each[120:] == pytest.approx([each[-1]] * 180)
    assert each[0] > 2 * each[-1]
    assert 0.3 < shares[-1] < 0.5  # the rest is the check and the final bundle adjustment


@pytest.fixture
def now(monkeypatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(time_left.time, "monotonic", lambda: now[0])
    return now


def of_sfm(**later: float) -> SfmTimeLeft:
    """The time left of 50 photos with one thread."""
    photos = Photos(stills=50, longest=1600)
    return SfmTimeLeft(photos, None, "normal", 1, Later(**later))


def first_report(left: SfmTimeLeft, stage: str, *counts) -> float:
    lines = []
    left.report(stage, lambda *line: lines.append(line))(*counts)
    (line,) = lines
    assert line[:3] == counts
    return line[3]


def test_the_sum_of_the_stages(now):
    steps = steps_of(Photos(stills=50, longest=1600), None, "normal")
    every = sum(step.work for name, step in steps.items() if name != "start")
    left = of_sfm()
    assert first_report(left, "photos", 0, 50, "photos") == pytest.approx(every, abs=0.1)
    left = of_sfm(work=300.0)
    assert first_report(left, "photos", 0, 50, "photos") == pytest.approx(every + 300.0, abs=0.1)
    left = of_sfm(deadline=now[0] + 5000.0)
    assert first_report(left, "photos", 0, 50, "photos") == 5000.0
    left.finished_before("poses")
    rest = steps["images"].work + steps["report"].work
    assert first_report(left, "images", 0, 50, "photos") == 5000.0
    left = of_sfm()
    left.finished_before("poses")
    assert first_report(left, "images", 0, 50, "photos") == pytest.approx(rest, abs=0.1)


def test_the_numbers_of_features_and_of_pairs_correct_the_prediction(now):
    left = of_sfm()
    expected = first_report(left, "poses", 0, 1225, "matched pairs")
    left.figures(0.0, 2560.0)  # half as many features: a quarter of the work to match them
    fewer = first_report(left, "poses", 0, 1225, "matched pairs")
    assert fewer < expected - 0.75 * 1225 * 0.02
    assert first_report(left, "poses", 0, 100, "matched pairs") < fewer
