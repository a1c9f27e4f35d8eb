"""The model of the time of steps, and its calibration."""

import pytest

from snowsplat.training.budgets.pace import Pace
from snowsplat.training.budgets.step_cost import StepCost, Work
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule

from .test_pace import FINAL, PIXELS, VIEWS, usual

STEPS = 3000


def test_a_densification_adds_a_quarter_until_the_limit():
    """Ten densifications remain after step 0, none after step 1000."""
    config = recipe("classic", iterations=2000, max_gaussians=1_000_000)
    work = Work(config, 500_000.0, 6)
    parts = work.parts_ahead(Schedule(2000), 0, 10_000)
    assert parts[-1] == (1, pytest.approx(10_000 * 1.25**10))
    assert {count for _, count in work.parts_ahead(Schedule(2000), 1000, 10_000)} == {10_000}
    limited = Work(recipe("default", iterations=2000, max_gaussians=15_000), 500_000.0, 6)
    assert limited.parts_ahead(Schedule(2000), 0, 10_000)[-1] == (1, 15_000)


def test_a_geometric_growth_reaches_the_limit_early():
    work = Work(recipe("default", iterations=2000, max_gaussians=20_000), 500_000.0, 6)
    counts = [count for _, count in work.parts_ahead(Schedule(2000), 50, 10_000, 1.5)]
    # The first densification is at step 100, the second at 200; parts are 49 steps long.
    assert counts[:5] == [10_000, 15_000, 15_000, 20_000, 20_000]
    assert counts[-1] == 20_000


def observed(*factors):
    """The cost after steps that took these multiples of the modelled time, and its parts ahead."""
    work = Work(recipe("default"), 500_000.0, 6)
    cost, usual = StepCost(work, 1.0, 3.0), work.seconds(1, 50_000)
    for factor in factors:
        cost.observe(factor * usual, 1, 50_000)
    return cost.predict(1, 50_000) / usual, cost.mean([(1, 50_000.0)]) / usual


def test_a_long_step_is_rare_and_does_not_change_the_others():
    assert observed(1, 8, 1, 1) == observed(1, 8000, 1, 1) == pytest.approx((1.0, 1.0))


def test_what_repeats_itself_is_expected_again():
    """Steps with a densification take longer; a sleep of the computer is not expected again."""
    usual, mean = observed(*[1, 1, 1, 8, 1] * 4)
    assert usual == pytest.approx(1.0)
    assert mean == pytest.approx(1.0 + 7 / 5)
    assert observed(*[1, 1, 1, 8, 1] * 4, 9000)[1] == pytest.approx(2.4, abs=0.3)


def test_what_does_not_repeat_itself_any_more_is_expected_less():
    usual, mean = observed(*[1, 1, 1, 8, 1] * 20, *[1] * 68)
    assert usual == pytest.approx(1.0)
    assert mean == pytest.approx(1.0 + 7 * 6 / 99)  # six times in the last 99 steps
    assert mean < 1.0 + 7 * 20 / 168


def test_a_machine_that_has_become_slow_is_noticed():
    assert observed(*[4] * 1000)[0] == pytest.approx(4.0, rel=0.01)
    assert observed(1, 4000, 4000)[0] == observed(1, 5, 5)[0] > 1.0


def test_without_a_ratio_that_of_the_second_step_is_taken():
    work = Work(recipe("default"), 500_000.0, 6)
    cost, usual = StepCost(work, None, 3.0), work.seconds(1, 50_000)
    for factor in (50, 2):  # the first step waits for its photo
        cost.observe(factor * usual, 1, 50_000)
    assert cost.predict(2, 80_000) == pytest.approx(2 * work.seconds(2, 80_000))


def estimates(cost, pause=0.0, last_part=0.0):
    """For each step: the share of the time that is over, and the estimate of the time left divided
    by the true time left."""
    config = recipe("classic", iterations=STEPS)
    schedule, now, gaussians = Schedule(STEPS), 100.0, 10_000
    left = Pace(Work(config, PIXELS, VIEWS, last_part * STEPS), clock=lambda: now)
    told = []
    for step in range(1, STEPS + 1):
        downscale = config.downscale_at(step, schedule)
        now += cost(downscale, gaussians, step / STEPS)
        if step % 100 == 0 and step <= schedule.step_of(config.density.densify_until):
            gaussians = min(FINAL, int(1.4 * gaussians))
        if step == 700:
            now += pause
            left.postpone(pause)
        left.after_step(schedule, step, downscale, gaussians)
        told.append((now, left.seconds_left))
    now += last_part * STEPS * cost(1, gaussians, 1.0) + 0.05 * VIEWS
    return [((at - 100.0) / (now - 100.0), seconds / (now - at)) for at, seconds in told[:-1]]


@pytest.mark.parametrize(("slowness", "last_part"), [(0.3, 0.0), (1.0, 0.12), (4.0, 0.0)])
def test_from_a_tenth_of_the_time_on_the_error_is_at_most_30_percent(slowness, last_part):
    found = estimates(lambda *args: slowness * usual(*args), last_part=last_part)
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
