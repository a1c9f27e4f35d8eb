"""Learning rates and their schedule."""

import pytest

from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule


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
