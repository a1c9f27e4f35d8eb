"""Settings: the paper's values, changing them by name, limits, and the form on disk."""

import json
import math
from dataclasses import replace

import pytest
import torch

from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.density import McmcDensity
from snowsplat.training.settings import TrainConfig, changed, config_from_json, config_to_json
from snowsplat.training.settings.recipes import RECIPES, recipe
from snowsplat.util.errors import SettingError, UserError


def test_the_papers_values():
    config = TrainConfig()
    assert (config.iterations, config.seed, config.background) == (30_000, 0, "black")
    assert (config.sh_degree, config.sh_interval) == (3, 1000)
    assert config.ssim_weight == 0.2
    assert (config.initial_opacity, config.initial_scale) == (0.1, 1.0)
    assert config.initial_points == 100_000
    assert (config.gaussians_per_pixel, config.visible_only) == (0.0, False)
    assert config.coarse_to_fine == (0, 0)
    assert (config.leave_out_after, config.image_memory, config.checkpoint_every) == (0, 0, 0)
    assert config.test_iterations == (7_000, 30_000)


def test_the_resolution_increases_after_two_moments():
    config = TrainConfig(coarse_to_fine=(10, 0.5))
    schedule = Schedule(40)
    assert [config.downscale_at(s, schedule) for s in (1, 10, 11, 20, 21)] == [4, 4, 2, 2, 1]


def test_the_sh_degree_increases_by_interval():
    config = TrainConfig(sh_interval=200, sh_degree=3)
    assert [config.sh_degree_at(s) for s in (1, 199, 200, 400, 600, 5000)] == [0, 0, 1, 2, 3, 3]
    assert replace(config, sh_degree=1).sh_degree_at(5000) == 1
    assert replace(config, sh_interval=0).sh_degree_at(1) == 3


def test_settings_are_changed_by_name():
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
        ("leave_out_after", math.nan),
        ("leave_out_after", -0.2),
    ],
)
def test_invalid_values_name_their_setting(name, value):
    with pytest.raises(SettingError, match=f"^{name}: .*; use ") as error:
        recipe("paper", **{name: value})
    assert error.value.setting == name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_sh_degree_is_accepted(degree):
    assert recipe("paper", sh_degree=degree).sh_degree_at(30_000) == degree


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 1),
        ("initial_points", 1),
        ("densify_interval", 1),
        *(("sh_degree", degree) for degree in range(4)),
        ("lr_means", 1e-12),
        ("lr_means_final", 1e-12),
        ("lr_means_steps", 0),
        ("densify_until", 0.0),
    ],
)
def test_the_smallest_valid_values_are_accepted(name, value):
    recipe("paper", **{name: value})


def test_the_largest_seeds_are_accepted():
    for seed in (2**61 - 1, -(2**61)):
        torch.Generator().manual_seed(4 * recipe("paper", seed=seed).seed + 3)


@pytest.mark.parametrize("name", RECIPES)
def test_json_round_trip(name):
    config = recipe(name, test_iterations=(10, 20), coarse_to_fine=(5, 0.25))
    written = json.dumps(config_to_json(config))
    assert config_from_json(json.loads(written)) == config


def test_settings_that_an_earlier_version_did_not_have_get_their_default():
    values = config_to_json(recipe("paper", abs_grad=True))
    assert config_from_json(values).density.abs_grad
    del values["density"]["abs_grad"]
    assert config_from_json(values) == recipe("paper")


def test_the_configuration_of_another_version_is_rejected():
    values = config_to_json(TrainConfig())
    with pytest.raises(UserError, match="another version"):
        config_from_json(values | {"gravity": 9.81})
    with pytest.raises(UserError, match="another version"):
        config_from_json({})


def test_the_limit_follows_the_size_of_the_photos():
    config = recipe("default")
    assert config.gaussians_per_pixel > 0
    small = config.capped(1000, 40)
    assert small.density.max_gaussians == round(1000 * config.gaussians_per_pixel)
    assert small.capped(2000, 400) == small  # it is final
    assert config.capped(10**9, 40).density == config.density
    # A limit that is set explicitly takes precedence.
    explicit = recipe("default", max_gaussians=200_000)
    assert explicit.capped(1000, 400).density.max_gaussians == 200_000
    assert recipe("paper").capped(1000, 40).density.max_gaussians == 0
    assert recipe("default").capped(1, 40).density.max_gaussians == 1
    per_pixel = replace(recipe("paper"), gaussians_per_pixel=0.5)
    assert per_pixel.capped(99, 400).density.max_gaussians == 50


def test_the_limit_grows_with_the_number_of_views():
    config = recipe("default")
    few, many = (config.capped(1000, n).density.max_gaussians for n in (50, 200))
    assert many == 2 * few == 2 * config.capped(1000, 3).density.max_gaussians
    assert recipe("classic").capped(1000, 200) == recipe("classic").capped(1000, 50)


@pytest.mark.parametrize(("limit", "expected"), [(1, 1), (249, 249), (250, 250), (251, 250)])
def test_the_smaller_limit_counts(limit, expected):
    config = recipe("paper", max_gaussians=limit, gaussians_per_pixel=0.25)
    assert config.gaussians_per_pixel == 0.25
    assert config.capped(1000, 40).density.max_gaussians == expected
