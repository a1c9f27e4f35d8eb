"""The schedule: moments of a training in steps, and learning rates."""

import pytest

from snowsplat.training.settings.rates import LearningRates
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


def test_the_papers_rates():
    rates = LearningRates()
    first = rates.at(0, Schedule(30_000), extent=2.0)
    last = rates.at(30_000, Schedule(30_000), extent=2.0)
    assert first["means"] == pytest.approx(2 * 1.6e-4)
    assert last["means"] == pytest.approx(2 * 1.6e-6)
    middle = rates.at(15_000, Schedule(30_000), extent=2.0)
    assert middle["means"] == pytest.approx(2 * 1.6e-5)  # log-linear
    assert {name: rate for name, rate in first.items() if name != "means"} == {
        "log_scales": 5e-3,
        "quats": 1e-3,
        "opacity_logits": 0.05,
        "sh_dc": 2.5e-3,
        "sh_rest": 1.25e-4,
    }


def test_the_means_rate_ends_at_its_own_step_and_stays():
    absolute = LearningRates(means_steps=1000)
    assert absolute.at(1000, Schedule(4000), 1.0)["means"] == pytest.approx(1.6e-6)
    assert absolute.at(4000, Schedule(4000), 1.0)["means"] == pytest.approx(1.6e-6)
    relative = LearningRates(means_steps=0.5)
    assert relative.at(1000, Schedule(4000), 1.0)["means"] == pytest.approx(1.6e-5)
    assert relative.at(2000, Schedule(4000), 1.0)["means"] == pytest.approx(1.6e-6)


def test_annealing_begins_at_its_moment_and_ends_at_its_factor():
    rates, schedule = LearningRates(anneal=0.01, anneal_from=0.5), Schedule(1000)
    constant = LearningRates().at(500, schedule, 1.0)
    assert rates.at(1, schedule, 1.0) == LearningRates().at(1, schedule, 1.0)
    assert rates.at(500, schedule, 1.0) == constant
    for name, rate in constant.items():
        if name != "means":  # they have a schedule of their own
            assert rates.at(750, schedule, 1.0)[name] == pytest.approx(0.1 * rate)
            assert rates.at(1000, schedule, 1.0)[name] == pytest.approx(0.01 * rate)
    assert rates.at(1000, schedule, 1.0)["means"] == pytest.approx(
        LearningRates().at(1000, schedule, 1.0)["means"]
    )


@pytest.mark.parametrize(
    ("views", "factor"), [(0, 1.0), (10, 1.0), (25, 1.0), (50, 2**1.5), (75, 3**1.5), (1000, 6.0)]
)
def test_with_few_passes_view_dependent_colours_change_faster(views, factor):
    """Of 1000 steps, 25 photos have 40 passes each."""
    rates, schedule = LearningRates(sh_rest_passes=40.0), Schedule(1000)
    usual, found = LearningRates().at(9, schedule, 1.0), rates.at(9, schedule, 1.0, views)
    assert found.pop("sh_rest") == pytest.approx(factor * usual.pop("sh_rest"))
    assert found == usual


def test_scaled_leaves_the_final_rate_unchanged():
    rates = LearningRates().scaled(3.0)
    assert rates.means == pytest.approx(4.8e-4)
    constant = [getattr(rates, name) for name in ("log_scales", "quats", "opacity_logits")]
    assert constant == pytest.approx([0.015, 0.003, 0.15])
    assert [rates.sh_dc, rates.sh_rest] == pytest.approx([7.5e-3, 3.75e-4])
    assert rates.means_final == 1.6e-6
    assert rates.means_steps == 30_000
    assert LearningRates(anneal=0.1).scaled(3.0).anneal == 0.1
