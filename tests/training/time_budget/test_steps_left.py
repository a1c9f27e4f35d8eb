"""The estimated time until the last step, on simulated machines."""

import pytest

from snowsplat.training.budgets.pace import Pace
from snowsplat.training.budgets.step_cost import Work
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule

from .test_pace import FINAL, PIXELS, VIEWS, usual

STEPS = 3000


def estimates(cost, pause=0.0):
    """For each step: the share of the time that is over, and the estimate of the time left divided
    by the true time left."""
    config = recipe("classic", iterations=STEPS)
    schedule, now, gaussians = Schedule(STEPS), 100.0, 10_000
    left = Pace(Work(config, PIXELS, VIEWS), clock=lambda: now)
    times, estimated = [], []
    for step in range(1, STEPS + 1):
        downscale = config.downscale_at(step, schedule)
        now += cost(downscale, gaussians, step / STEPS)
        if step % 100 == 0 and step <= schedule.step_of(config.density.densify_until):
            gaussians = min(FINAL, int(1.4 * gaussians))
        if step == 700:
            now += pause
            left.postpone(pause)
        times.append(now)
        left.after_step(schedule, step, downscale, gaussians)
        estimated.append(left.seconds_left)
    whole = times[-1] - 100.0
    return [
        ((time - 100.0) / whole, seconds / (times[-1] - time))
        for time, seconds in zip(times[:-1], estimated[:-1], strict=True)
    ]


@pytest.mark.parametrize("slowness", [0.3, 1.0, 4.0])
def test_from_a_tenth_of_the_time_on_the_error_is_at_most_30_percent(slowness):
    found = estimates(lambda *args: slowness * usual(*args))
    ratios = [ratio for share, ratio in found if 0.1 < share < 0.9]
    assert min(ratios) > 0.7
    assert max(ratios) < 1.3


def measured(downscale, gaussians, when):
    """As fox: no fixed time; the image takes less and Gaussians take more than in the model."""
    return 0.15 * PIXELS / 1e6 / downscale**2 + 0.36 * gaussians / 1e6


def test_from_a_tenth_of_the_steps_on_too():
    """A tenth of the steps is a thirtieth of the time: small photos, and few Gaussians."""
    found = estimates(lambda *args: measured(*args) + 0.4 * (round(args[2] * STEPS) % 100 == 1))
    tenth = STEPS // 10
    assert found[tenth][0] < 0.04
    ratios = [ratio for share, ratio in found[tenth:] if share < 0.9]
    assert min(ratios) > 0.7
    assert max(ratios) < 1.3


def test_a_pause_does_not_count():
    paused = dict(enumerate(estimates(usual, pause=500.0)))
    whole = dict(enumerate(estimates(usual)))
    for step in (900, 2000):
        assert paused[step][1] == pytest.approx(whole[step][1], rel=0.01)
