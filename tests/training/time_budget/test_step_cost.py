"""The model of the time of steps, and its calibration."""

import pytest

from snowsplat.training.budgets.step_cost import StepCost, Work
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.settings.recipes import recipe


def test_a_densification_adds_a_quarter_until_the_limit():
    """Ten densifications remain after step 0, none after step 1000."""
    config = recipe("classic", iterations=2000, max_gaussians=1_000_000)
    work = Work(config, 500_000.0, 6)
    parts = work.parts_ahead(Schedule(2000), 0, 10_000)
    assert parts[-1] == (1, pytest.approx(10_000 * 1.25**10))
    assert {count for _, count in work.parts_ahead(Schedule(2000), 1000, 10_000)} == {10_000}
    limited = Work(recipe("default", iterations=2000, max_gaussians=15_000), 500_000.0, 6)
    assert limited.parts_ahead(Schedule(2000), 0, 10_000)[-1] == (1, 15_000)


def test_an_outlier_counts_as_five_steps():
    work = Work(recipe("default"), 500_000.0, 6)
    predictions = []
    for factor in (5.0, 1000.0):
        cost = StepCost(work, 1.0, 3.0)
        cost.observe(factor * work.seconds(1, 50_000), 1, 50_000)
        predictions.append(cost.predict(1, 50_000))
    assert predictions[0] == predictions[1] > work.seconds(1, 50_000)
