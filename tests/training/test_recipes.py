"""Recipes, and changing single knobs of them."""

import json
import math
from dataclasses import replace

import pytest
import torch

from snowsplat.training.config import TrainConfig, changed, config_from_json, config_to_json
from snowsplat.training.density import AdaptiveDensity, McmcDensity
from snowsplat.training.recipes import RECIPES, recipe
from snowsplat.training.step_schedule import Schedule
from snowsplat.util.errors import SettingError, UserError


def test_the_paper_comes_to_its_end_at_any_length():
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


def test_the_short_one_scales_with_its_length():
    config = recipe("default", iterations=1000)
    schedule = Schedule(config.iterations)
    assert schedule.step_of(config.density.densify_until) == 500
    assert [config.downscale_at(step, schedule) for step in (1, 150, 151, 400, 401, 1000)] == [
        4,
        4,
        2,
        2,
        1,
        1,
    ]
    assert config.learning_rates.at(1000, schedule, 1.0)["means"] == pytest.approx(1.6e-5)
    assert config.density.opacity_reset_interval == 0
    assert config.density.prune_world_size == 0


def test_degrees_rise_by_interval():
    config = TrainConfig(sh_interval=200, sh_degree=3)
    assert [config.sh_degree_at(s) for s in (1, 199, 200, 400, 600, 5000)] == [0, 0, 1, 2, 3, 3]
    assert replace(config, sh_degree=1).sh_degree_at(5000) == 1
    assert replace(config, sh_interval=0).sh_degree_at(1) == 3


def test_knobs_are_found_where_they_are():
    config = recipe("default", iterations=50, grad_threshold=4e-4, lr_quats=0.5, seed=None)
    assert config.iterations == 50
    assert config.seed == 0
    assert config.density.grad_threshold == 4e-4
    assert config.learning_rates.quats == 0.5
    assert recipe("mcmc", max_gaussians=7).density.max_gaussians == 7
    other = changed(config, density=McmcDensity(), growth=0.1)
    assert other.density == McmcDensity(growth=0.1)


@pytest.mark.parametrize("name", ["lr_nothing", "growth", "nothing"])
def test_an_unknown_setting_is_named(name):
    with pytest.raises(SettingError, match=f"^{name}: not a setting of AdaptiveDensity"):
        recipe("paper", **{name: 1.0})


def test_no_such_recipe():
    with pytest.raises(UserError, match="no recipe 'fast'; there are default, paper, mcmc"):
        recipe("fast")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 0),
        ("initial_points", 0),
        ("densify_interval", 0),
        ("sh_degree", 4),
        ("sh_degree", -1),
        ("seed", 2**61),
        ("seed", -(2**61) - 1),
        ("lr_means", 0.0),
        ("lr_means_final", -1e-6),
        ("lr_means_steps", math.inf),
        ("densify_from", math.nan),
        ("densify_until", math.inf),
    ],
)
def test_invalid_values_name_their_setting(name, value):
    with pytest.raises(SettingError, match=f"^{name}: .*; use ") as error:
        recipe("paper", **{name: value})
    assert error.value.setting == name


def test_the_largest_seeds_are_accepted():
    for seed in (2**61 - 1, -(2**61)):
        torch.Generator().manual_seed(4 * recipe("paper", seed=seed).seed + 3)


@pytest.mark.parametrize("name", RECIPES)
def test_written_down_and_read_back(name):
    config = recipe(name, test_iterations=(10, 20), coarse_to_fine=(5, 0.25))
    written = json.dumps(config_to_json(config))
    assert config_from_json(json.loads(written)) == config


def test_a_configuration_of_another_version():
    values = config_to_json(TrainConfig())
    with pytest.raises(UserError, match="another version"):
        config_from_json(values | {"gravity": 9.81})
    with pytest.raises(UserError, match="another version"):
        config_from_json({})


def test_the_cap_follows_the_size_of_the_photos():
    config = recipe("default")
    assert config.gaussians_per_pixel > 0
    small = config.capped(1000).density.max_gaussians
    assert small == round(1000 * config.gaussians_per_pixel)
    assert config.capped(10**9) == config
    # A cap that is asked for is the cap.
    assert recipe("default", max_gaussians=200_000).capped(1000).density.max_gaussians == 200_000
    assert recipe("paper").capped(1000).density.max_gaussians == 0
