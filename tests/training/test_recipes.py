"""Recipes: the moments and limits that distinguish them."""

import pytest

from snowsplat.training.density import AdaptiveDensity, McmcDensity
from snowsplat.training.settings.rates import DecayRates
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule
from snowsplat.util.errors import SettingError


def test_the_paper_completes_its_schedule_at_any_length():
    for iterations in (7000, 30_000):
        config = recipe("paper", iterations=iterations)
        density, schedule = config.density, Schedule(iterations)
        assert isinstance(density, AdaptiveDensity)
        assert config.sh_interval == 1000
        assert config.ssim_weight == 0.2
        assert not config.visible_only
        assert config.downscale_at(1, schedule) == 1
        assert schedule.step_of(density.densify_from) == 500
        assert schedule.step_of(density.densify_until) == iterations // 2
        assert schedule.step_of(config.learning_rates.means_steps) == iterations
        assert (density.densify_interval, density.opacity_reset_interval) == (100, 3000)
        assert (density.grad_threshold, density.prune_opacity) == (2e-4, 0.005)


@pytest.mark.parametrize(("name", "until"), [("default", 700), ("classic", 500)])
def test_the_short_recipes_scale_with_their_length(name, until):
    config = recipe(name, iterations=1000)
    schedule = Schedule(config.iterations)
    assert schedule.step_of(config.density.densify_until) == until
    steps = (1, 150, 151, 400, 401, 1000)
    assert [config.downscale_at(step, schedule) for step in steps] == [4, 4, 2, 2, 1, 1]
    assert config.learning_rates.at(1000, schedule, 1.0)["means"] == pytest.approx(1.6e-5)
    assert config.density.opacity_reset_interval == 0
    assert config.density.prune_world_size == 0


@pytest.mark.parametrize("name", ["classic", "paper", "mcmc"])
def test_the_other_recipes_neither_anneal_nor_decay(name):
    config = recipe(name)
    assert config.learning_rates.anneal == 1.0
    assert config.decay == DecayRates()
    default = recipe("default")
    assert default.learning_rates.anneal < 1.0
    assert min(default.decay.opacity, default.decay.scale) > 0.0


def test_an_unknown_recipe_is_rejected():
    with pytest.raises(
        SettingError,
        match="^recipe: 'fast' is unknown; use one of default, classic, paper, mcmc",
    ):
        recipe("fast")


def test_mcmc_has_the_initialisation_of_its_paper_and_a_limit():
    config = recipe("mcmc")
    assert isinstance(config.density, McmcDensity)
    assert config.density.max_gaussians == 200_000
    assert (config.initial_opacity, config.initial_scale) == (0.5, 0.1)
    assert config.iterations == 30_000
    assert not config.visible_only


def test_mcmc_short_reaches_its_limit_early_and_ends_without_noise():
    config = recipe("mcmc-short")
    density, schedule = config.density, Schedule(config.iterations)
    assert isinstance(density, McmcDensity)
    assert config.iterations == 3000
    steps = range(density.densify_from, 1050, density.densify_interval)
    assert 2_000 * (1 + density.growth) ** len(steps) > density.max_gaussians
    assert schedule.step_of(density.noise_until) == 2100
    assert schedule.step_of(config.learning_rates.anneal_from) == 2100
