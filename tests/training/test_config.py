"""`TrainConfig`: its defaults, the values that it rejects, and what follows from it at a step."""

import math
from dataclasses import replace
from typing import Any

import pytest

from snowsplat.training.config import TrainConfig, changed, config_from_json, config_to_json
from snowsplat.training.density import AdaptiveDensity, McmcDensity
from snowsplat.training.lr_schedule import LearningRates
from snowsplat.training.step_schedule import Schedule
from snowsplat.util.errors import SettingError, UserError


def test_defaults_are_those_of_the_paper():
    config = TrainConfig()
    assert (config.iterations, config.test_iterations) == (30_000, (7_000, 30_000))
    assert (config.sh_degree, config.sh_interval) == (3, 1000)
    assert config.ssim_weight == 0.2
    assert config.background == "black"
    assert (config.initial_opacity, config.initial_scale) == (0.1, 1.0)
    assert config.learning_rates == LearningRates()
    assert config.density == AdaptiveDensity()
    # What the paper does not have is off.
    assert config.coarse_to_fine == (0, 0)
    assert config.gaussians_per_pixel == 0.0
    assert not config.visible_only


def test_defaults_of_our_own():
    config = TrainConfig()
    assert config.seed == 0
    assert config.initial_points == 100_000
    assert (config.image_memory, config.checkpoint_every) == (0, 0)


VALID: list[dict[str, Any]] = [
    {"iterations": 1},
    {"initial_points": 1},
    *({"sh_degree": degree} for degree in range(4)),
    {"seed": 2**61 - 1},
    {"seed": -(2**61)},
    {"density": AdaptiveDensity(densify_interval=1)},
    {"density": AdaptiveDensity(densify_from=0.0, densify_until=0)},
    {"learning_rates": LearningRates(means=1e-12, means_final=1e-12, means_steps=0)},
]
INVALID: list[tuple[str, dict[str, Any]]] = [
    ("iterations", {"iterations": 0}),
    ("initial_points", {"initial_points": 0}),
    ("densify_interval", {"density": AdaptiveDensity(densify_interval=0)}),
    ("densify_interval", {"density": McmcDensity(densify_interval=-1)}),
    ("sh_degree", {"sh_degree": -1}),
    ("sh_degree", {"sh_degree": 4}),
    ("seed", {"seed": 2**61}),
    ("seed", {"seed": -(2**61) - 1}),
    ("lr_means", {"learning_rates": LearningRates(means=0.0)}),
    ("lr_means_final", {"learning_rates": LearningRates(means_final=-1e-6)}),
    ("densify_from", {"density": AdaptiveDensity(densify_from=math.inf)}),
    ("densify_until", {"density": McmcDensity(densify_until=math.nan)}),
    ("lr_means_steps", {"learning_rates": LearningRates(means_steps=math.nan)}),
]


@pytest.mark.parametrize("settings", VALID, ids=str)
def test_the_outermost_values_that_are_valid(settings: dict[str, Any]):
    TrainConfig(**settings)


@pytest.mark.parametrize(("name", "settings"), INVALID, ids=str)
def test_an_invalid_value_is_named(name: str, settings: dict[str, Any]):
    with pytest.raises(SettingError) as caught:
        TrainConfig(**settings)
    assert caught.value.setting == name


def test_the_cap_is_the_smaller_of_the_two():
    config = TrainConfig(gaussians_per_pixel=0.25)
    assert config.capped(1002).density.max_gaussians == 250  # of 250.5: to even
    assert config.capped(1).density.max_gaussians == 1
    for own, cap in ((249, 249), (250, 250), (251, 250), (1, 1)):
        limited = replace(config, density=AdaptiveDensity(max_gaussians=own))
        assert limited.capped(1000).density.max_gaussians == cap
    # Nothing else changes.
    assert replace(config.capped(1000), density=config.density) == config
    assert TrainConfig().capped(1000) == TrainConfig()
    denser = TrainConfig(gaussians_per_pixel=1.5)
    assert denser.capped(1000).density.max_gaussians == 1500


def test_resolutions_end_with_their_moment():
    config = TrainConfig(coarse_to_fine=(10, 0.5))
    steps = (1, 10, 11, 50, 51, 100)
    assert [config.downscale_at(step, Schedule(100)) for step in steps] == [4, 4, 2, 2, 1, 1]
    assert TrainConfig().downscale_at(1, Schedule(100)) == 1


def test_degrees_rise_to_the_highest():
    config = TrainConfig(sh_interval=10, sh_degree=2)
    assert [config.sh_degree_at(step) for step in (1, 9, 10, 19, 20, 30)] == [0, 0, 1, 1, 2, 2]
    assert TrainConfig(sh_interval=0, sh_degree=2).sh_degree_at(1) == 2
    assert TrainConfig(sh_interval=1).sh_degree_at(2) == 2


def test_a_cap_that_is_given_takes_the_place_of_one_by_size():
    config = TrainConfig(gaussians_per_pixel=0.5)
    assert changed(config, max_gaussians=7).capped(1000).density.max_gaussians == 7
    both = changed(config, max_gaussians=700, gaussians_per_pixel=0.25)
    assert both.gaussians_per_pixel == 0.25
    assert both.capped(1000).density.max_gaussians == 250
    assert changed(config, grad_threshold=1.0).gaussians_per_pixel == 0.5


def test_every_kind_of_setting_is_found_by_its_name():
    config = changed(TrainConfig(), iterations=5, grad_threshold=0.0, lr_means=2.0, seed=None)
    density = AdaptiveDensity(grad_threshold=0.0)
    rates = LearningRates(means=2.0)
    assert config == TrainConfig(iterations=5, density=density, learning_rates=rates)
    # The density control may be exchanged with settings of the new one.
    other = changed(TrainConfig(), density=McmcDensity(noise=1.0), growth=0.5)
    assert other.density == McmcDensity(noise=1.0, growth=0.5)


@pytest.mark.parametrize("name", ["means", "growth", "lr_growth", "lr_iterations"])
def test_a_setting_that_this_configuration_does_not_have(name: str):
    with pytest.raises(UserError, match="AdaptiveDensity"):
        changed(TrainConfig(), **{name: 1.0})


@pytest.mark.parametrize("density", [AdaptiveDensity(grad_threshold=1e-3), McmcDensity(growth=0.1)])
def test_json_and_back(density: AdaptiveDensity | McmcDensity):
    config = TrainConfig(density=density, learning_rates=LearningRates(quats=0.5), seed=3)
    values = config_to_json(config)
    before = dict(values)
    assert config_from_json(values) == config
    assert values == before
    assert values["density_control"] == type(density).__name__


@pytest.mark.parametrize(
    "damage",
    [
        {"density_control": "Gravity"},
        {"density": None},
        {"density": {"gravity": 1.0}},
        {"learning_rates": {"gravity": 1.0}},
        {"gravity": 9.81},
        {"iterations": "many"},
    ],
    ids=str,
)
def test_json_of_another_version_is_rejected(damage: dict[str, Any]):
    with pytest.raises(UserError, match="another version"):
        config_from_json(config_to_json(TrainConfig()) | damage)
