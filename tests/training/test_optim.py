"""Learning rates, and the bookkeeping of Adam's moments."""

import math

import pytest
import torch

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.lr_schedule import LearningRates
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule


def some_gaussians(n: int = 5, rest: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(n)
    shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, rest, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def test_the_papers_rates():
    rates = LearningRates()
    first, last = (
        rates.at(0, Schedule(30_000), extent=2.0),
        rates.at(30_000, Schedule(30_000), extent=2.0),
    )
    assert first["means"] == pytest.approx(2 * 1.6e-4)
    assert last["means"] == pytest.approx(2 * 1.6e-6)
    assert rates.at(15_000, Schedule(30_000), extent=2.0)["means"] == pytest.approx(
        2 * 1.6e-5
    )  # log-linear
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


def test_scaled_spares_the_final_rate():
    rates = LearningRates().scaled(3.0)
    assert rates.means == pytest.approx(4.8e-4)
    assert rates.opacity_logits == pytest.approx(0.15)
    assert rates.means_final == 1.6e-6
    assert rates.means_steps == 30_000


def test_moments_follow_the_rows_and_new_rows_start_at_zero():
    gaussians = some_gaussians()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for name, parameter in gaussians.parameters().items():
            moments[name] = (
                parameter.clone()
            )  # recognisable: row i of the moment is that of Gaussian i
    index = torch.tensor([4, 0, 2, 2])
    fresh = torch.tensor([False, False, False, True])
    selected = gaussians.select(index)
    adam.select(index, fresh)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for name, parameter in selected.parameters().items():
            assert torch.equal(moments[name][:3], parameter[:3])
            assert not moments[name][3].any()


def test_zero_forgets_one_parameter_alone():
    gaussians = some_gaussians()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for moment in moments.values():
            moment.fill_(1.0)
    adam.zero("opacity_logits")
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        zeroed = {name for name, moment in moments.items() if not moment.any()}
        assert zeroed == {"opacity_logits"}


def test_state_comes_back_as_copies():
    adam = Adam(some_gaussians(5), LearningRates(), schedule=Schedule(10), extent=1.0)
    adam.exp_avg["means"].normal_()
    state = adam.state_tensors()
    assert len(state) == 12
    other = Adam(some_gaussians(3), LearningRates(), schedule=Schedule(10), extent=1.0)
    other.load_state(state)
    assert torch.equal(other.exp_avg["means"], adam.exp_avg["means"])
    adam.exp_avg["means"].zero_()
    assert other.exp_avg["means"].any()


def test_rates_reach_the_end_of_the_training():
    adam = Adam(
        some_gaussians(), LearningRates(means_steps=1.0), schedule=Schedule(200), extent=5.0
    )
    assert adam.rates_at(200)["means"] == pytest.approx(5 * 1.6e-6)
    assert math.log10(adam.rates_at(100)["means"] / 5) == pytest.approx(math.log10(1.6e-5))
