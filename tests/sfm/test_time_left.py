"""The estimate of the time until structure from motion is finished, with simulated clocks."""

import itertools

import pytest

from snowsplat.sfm import time_left
from snowsplat.sfm.cost import Photos, Speed, share_of_poses, steps_of
from snowsplat.sfm.time_left import Later, SfmTimeLeft


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


STEPS_AFTER = ("pairs", "verified", "poses", "load", "images", "report")  # "features"


def predicted() -> dict[str, float]:
    """The seconds of each step of `of_sfm` on the reference machine."""
    steps = steps_of(Photos(stills=50, longest=1600), None, "normal")
    return {name: step.seconds(Speed()) for name, step in steps.items()}


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
    left = of_sfm(seconds=300.0)
    assert first_report(left, "photos", 0, 50, "photos") == pytest.approx(every + 300.0, abs=0.1)
    left = of_sfm(deadline=now[0] + 5000.0)
    assert first_report(left, "photos", 0, 50, "photos") == 5000.0
    left.finished_before("poses")
    rest = steps["images"].work + steps["report"].work
    assert first_report(left, "images", 0, 50, "photos") == 5000.0
    left = of_sfm()
    left.finished_before("poses")
    assert first_report(left, "images", 0, 50, "photos") == pytest.approx(rest, abs=0.1)


def test_the_number_of_pairs_corrects_the_prediction(now):
    left = of_sfm()
    every = first_report(left, "poses", 0, 1225, "matched pairs")
    assert first_report(left, "poses", 0, 100, "matched pairs") < every - 1125 * 0.02


def work(left: SfmTimeLeft, now: list[float], step: str, seconds: float, begin=0.0, end=1.0):
    """Report the share of a step from ``begin`` to ``end``, which takes ``seconds``, in parts."""
    left.update(step, begin)
    for part in range(1, 21):
        now[0] += seconds / 20
        left.update(step, begin + (end - begin) * part / 20)


@pytest.mark.parametrize("slowness", [0.3, 1.0, 4.0])
def test_the_finished_work_tells_the_speed_of_the_machine(now, slowness):
    left, seconds = of_sfm(), predicted()
    work(left, now, "features", 0.5 * slowness * seconds["features"], end=0.5)
    rest = sum(seconds[name] for name in (*STEPS_AFTER, "features"))
    rest -= 0.5 * seconds["features"]
    assert left.seconds == pytest.approx(slowness * rest, rel=0.3)


def test_a_step_that_is_slower_than_predicted_hardly_affects_the_others(now):
    left, seconds = of_sfm(), predicted()
    work(left, now, "features", seconds["features"])
    work(left, now, "pairs", 3 * 0.5 * seconds["pairs"], end=0.5)
    rest = 1.5 * seconds["pairs"] + sum(seconds[name] for name in STEPS_AFTER[1:])
    assert rest <= left.seconds < 2.0 * rest
    left.update("verified", 0.0)
    work(left, now, "poses", 2 * 0.9 * seconds["poses"], end=0.9)
    left.update("poses", 0.5)  # another attempt takes as long as the one before
    rest = seconds["poses"] + sum(seconds[name] for name in STEPS_AFTER[3:])
    assert left.seconds == pytest.approx(rest, rel=0.5)


def test_the_time_left_decreases_while_nothing_is_reported_and_never_ends_before_the_job(now):
    left = of_sfm()
    work(left, now, "report", 2.0, end=0.5)
    before = left.seconds
    now[0] += 0.5 * before
    assert left.seconds == pytest.approx(0.5 * before)
    now[0] += 20.0
    assert left.seconds == pytest.approx(0.25 * (20.0 + 0.5 * before))
