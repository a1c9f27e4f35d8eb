"""The length of a training run, and the effect of stretching it on its moments."""

import pytest

from snowsplat.training.settings.schedule import Schedule


def test_moments():
    schedule = Schedule(7000)
    assert schedule.step_of(500) == 500
    assert schedule.step_of(0.5) == 3500
    assert schedule.step_of(1.0) == 7000
    assert schedule.step_of(1) == 1


def test_fractions():
    schedule = Schedule(3000)
    assert schedule.share(0) == 0.0
    assert schedule.share(1) == 1 / 3000
    assert schedule.share(3000) == 1.0
    assert schedule.share(250, 1000) == 0.25
    assert schedule.share(375, 0.25) == 0.5
    assert schedule.share(2000, 1000) == schedule.share(2000, 0.25) == 1.0
    assert schedule.share(5, 0.0) == 1.0


@pytest.mark.parametrize("iterations", [501, 600, 1000, 1600, 9000])
def test_stretching(iterations):
    """The schedule is stretched at step 500 of 1000.

    Fractions are continuous and monotonic, and future moments are reached.
    """
    schedule = Schedule(1000)
    moments = (0.2, 0.4999, 0.5, 0.7, 1.0)
    before = [schedule.share(500, when) for when in moments]
    schedule.stretch(500, iterations)
    assert [schedule.share(500, when) for when in moments] == pytest.approx(before)
    assert schedule.step_of(0.2) == 200
    assert schedule.step_of(0.4999) <= 500
    assert schedule.step_of(0.75) == pytest.approx((500 + iterations) / 2, abs=0.51)
    assert schedule.step_of(1.0) == iterations
    assert schedule.step_of(300) == 300
    shares = [schedule.share(step) for step in range(500, iterations + 1)]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_stretching_repeatedly():
    schedule = Schedule(100)
    shares = []
    for step in range(1, 100):
        shares.append(schedule.share(step))
        schedule.stretch(step, 100 + step % 7)
    assert shares == sorted(shares)
    assert schedule.step_of(0.3) <= 40
    assert schedule.share(schedule.iterations) == 1.0


def test_the_past_cannot_be_changed():
    schedule = Schedule(100)
    with pytest.raises(ValueError, match="cannot change to 40 steps: 50 of 100 are completed"):
        schedule.stretch(50, 40)
    with pytest.raises(ValueError, match="are completed"):
        schedule.stretch(100, 200)
