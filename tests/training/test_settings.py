"""Settings: the paper's values, wrong values from Python and shell, names, the form on disk."""

import json
import math
import subprocess
import sys
from dataclasses import dataclass, make_dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from snowsplat.cli.main import main
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.train import train
from snowsplat.training.settings import (
    DENSITY_CONTROLS,
    RECIPES,
    STARTS,
    AdaptiveDensity,
    DecayRates,
    LearningRates,
    McmcDensity,
    TrainConfig,
    changed,
    config_from_json,
    config_to_json,
    recipe,
    register_density,
    register_recipe,
    register_start,
)
from snowsplat.training.settings.schedule import Schedule
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.settings import declarations

from ..fork_server import ENVIRONMENT


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


# Name, value in Python, text in the shell (None: there is no flag), and what the error says.
WRONG = [
    ("iterations", 0, "0", "0 is too small; use a whole number of at least 1"),
    ("iterations", "12", "many", "use a whole number of at least 1"),
    ("iterations", 10.5, "10.5", "use a whole number of at least 1"),
    ("iterations", True, "True", "use a whole number of at least 1"),
    ("iterations", 2**63, 2**63, "is too large"),
    ("batch", -1, "-1", "-1 is too small"),
    ("seed", 2**61, 2**61, "too large; use a whole number closer to 0"),
    ("seed", -(2**61) - 1, -(2**61) - 1, "too small; use a whole number closer to 0"),
    ("checkpoint_every", -5, "-5", "-5 is too small; use a whole number of at least 0"),
    ("test_iterations", [10, "a"], "a", "each item is a whole number of at least -1"),
    ("test_iterations", 10, None, "10 has the wrong type; use a list"),
    ("background", "blue", "blue", "use black, white or random"),
    ("exposure", "maybe", "maybe", "use auto, on or off"),
    ("transients", True, "yes", "use auto, on or off"),
    ("antialias", 1, "1", "; use "),
    ("refine_poses", "yes", None, "'yes' has the wrong type; use True or False"),
    ("leave_out_after", -0.2, "-0.2", "-0.2 is too small"),
    ("leave_out_after", math.nan, "nan", "nan is not finite"),
    ("sh_degree", 4, "4", "4 is too large; use 0, 1, 2 or 3"),
    ("sh_degree", -1, "-1", "-1 is too small; use 0, 1, 2 or 3"),
    ("sh_interval", -1, None, "-1 is too small"),
    ("ssim_weight", 5, "5", "too large; use a number from 0 to 1"),
    ("ssim_weight", [0.2], "x", "use a number from 0 to 1"),
    ("init", "cloud", "cloud", "is unknown; use one of points, random, depth, sweep"),
    ("init", "points+swep", "points+swep", "is unknown ('swep'); did you mean sweep?"),
    ("init", "", "", "is unknown"),
    ("init", "points+", "points+", "is unknown ('')"),
    ("init", ("points",), None, "has the wrong type"),
    ("initial_points", 0, "0", "use a number such as 20000, or a share"),
    ("initial_points", 1.5, "1.5", "too large for a fraction; use a number such as 20000"),
    ("initial_points", math.nan, "nan", "not finite"),
    ("initial_opacity", 0, None, "0 is too small; use a number above 0 and below 1"),
    ("initial_opacity", 1.0, None, "1.0 is too large"),
    ("initial_scale", 0.0, None, "0.0 is too small; use a number above 0"),
    ("sky_distance", -1.0, "-1", "-1.0 is too small"),
    ("relative_scale", math.inf, None, "inf is not finite"),
    ("near_limit", -0.1, None, "-0.1 is too small"),
    ("coarse_to_fine", (1, 2, 3), None, "has 3 items instead of 2"),
    ("coarse_to_fine", (0.1, 1.5), None, "is too large for a fraction"),
    ("image_memory", -1, None, "-1 is too small"),
    ("max_gaussians", -3, "-3", "-3 is too small; use a whole number of at least 0"),
    ("percent_dense", math.nan, "nan", "nan is not finite"),
    ("grad_threshold", -1e-4, "-1e-4", "-0.0001 is too small"),
    ("abs_grad", 1, "2", "; use "),
    ("densify_interval", 0, "0", "0 is too small"),
    ("densify_from", math.inf, "inf", "inf is not finite"),
    ("densify_until", 500.0, "500.0", "500.0 is too large for a fraction"),
    ("opacity_reset_interval", -1, "-1", "-1 is too small"),
    ("prune_opacity", 1.0, None, "1.0 is too large"),
    ("lr_means", 0.0, "0", "0.0 is too small; use a number above 0, e.g. 1e-12"),
    ("lr_means_final", -1e-6, "-1e-6", "-1e-06 is too small"),
    ("lr_means_steps", math.inf, "inf", "inf is not finite"),
    ("lr_quats", -1.0, "-1", "-1.0 is too small"),
    ("lr_anneal", 0.0, None, "0.0 is too small"),
    ("lr_anneal_from", 1.0, None, "use a number of at least 0 and below 1"),
    ("decay_opacity", -1.0, None, "-1.0 is too small"),
    ("decay_until", math.nan, None, "nan is not finite"),
    ("density", AdaptiveDensity, None, "use e.g. AdaptiveDensity()"),
    ("density", "mcmc", None, "use e.g. AdaptiveDensity()"),
    ("learning_rates", 0.1, None, "use a LearningRates"),
]
#: As above; these are options of the training, not settings of its configuration.
WRONG_OPTIONS = [
    ("recipe", "defalt", "defalt", "; "),
    ("resolution", 0, "0", "use 1, 2, 4, 8 or a width"),
    ("resolution", "half", "half", "; use "),
    ("hold_out", 0, None, "0 is too small; use 2 or more"),
    ("minutes", 0, "0", "use a number above 0"),
    ("minutes", math.inf, "inf", "inf is not finite"),
    ("memory", "much", "much", "'much' is not a size; use e.g. 4GB or 800MB"),
    ("memory", 0, "0", "; use e.g. 4GB or 800MB"),
    ("save_iterations", ("a",), "a", "use a list; each item is a whole number"),
    ("last_part", -1.0, None, "-1.0 is too small"),
    ("checkpoint_seconds", -1.0, None, "-1.0 is too small"),
    ("settings", "fast", None, "has the wrong type"),
]


def ids(case: object) -> str | None:
    return case if isinstance(case, str) else None


@pytest.fixture
def refused(capsys, tmp_path):
    """Run the command; returns its error of one line. Nothing has been read or written."""

    def refused(*arguments: object) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        (line,) = err.splitlines()
        assert not list(tmp_path.iterdir())
        return line

    return refused


@pytest.fixture(autouse=True)
def no_training(monkeypatch):
    """Fails a test in which a training or structure from motion would start."""

    def started(*_: object) -> None:
        raise AssertionError("started")

    monkeypatch.setattr("snowsplat.pipeline.train._Job.__init__", started)
    monkeypatch.setattr("snowsplat.pipeline.make._Job.run", started)


@pytest.mark.parametrize(("name", "value", "text", "message"), WRONG, ids=ids)
def test_wrong_settings(name, value, text, message, refused, tmp_path):
    with pytest.raises(SettingError) as error:
        recipe("default", **{name: value})
    assert error.value.setting == name
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(SettingError, match=f"^{name}: "):
        train("nowhere", tmp_path / "out", TrainOptions(settings={name: value}))
    if text is not None:
        flag = "--" + name.replace("_", "-")
        line = refused("train", "nowhere", "-o", tmp_path / "out", flag, text)
        assert line.startswith(f"snowsplat: {flag}: ")
        assert "; " in line


@pytest.mark.parametrize(("name", "value", "text", "message"), WRONG_OPTIONS, ids=ids)
def test_wrong_options(name, value, text, message, refused, tmp_path):
    with pytest.raises(SettingError, match=f"^{name}: ") as error:
        TrainOptions(**{name: value})
    assert message in str(error.value)
    if text is not None:
        line = refused("train", "nowhere", "-o", tmp_path / "out", f"--{name}", text)
        assert line.startswith(f"snowsplat: --{name.replace('_', '-')}: ")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("threads", 0, "0 is too small; use a whole number of at least 1"),
        ("threads", 1.5, "; use a whole number"),
        ("device", "tpu", "'tpu' is unknown; use cpu, cuda, cuda:1 or webgpu"),
        ("minutes", -1, "use a number above 0"),
        ("memory", "4 GBs", "'4 GBs' is not a size; use e.g. 4GB or 800MB"),
        ("quality", "bset", "use draft, normal or best"),
    ],
)
def test_make_refuses_wrong_options_before_structure_from_motion(name, value, message, refused):
    options = Compute if name in ("threads", "device") else MakeOptions
    with pytest.raises(SettingError, match=f"^{name}: ") as error:
        options(**{name: value})
    assert message in str(error.value)
    line = refused("make", "nowhere", f"--{name}", value)
    assert line.startswith(f"snowsplat: --{name}: ")
    assert message.partition("; ")[2] in line


def test_an_unknown_name_gets_the_nearest_one_as_a_suggestion(refused):
    with pytest.raises(SettingError, match="^iteration: unknown setting; did you mean iterations?"):
        recipe("paper", iteration=5)
    with pytest.raises(SettingError, match="^lr_mean: unknown setting; did you mean lr_means?"):
        recipe("paper", lr_mean=0.1)
    with pytest.raises(SettingError, match="^gravity: unknown setting; remove it"):
        recipe("paper", gravity=9.81)
    with pytest.raises(SettingError, match="^recipe: 'papr' is unknown; did you mean paper?"):
        recipe("papr")
    line = refused("train", "nowhere", "-o", "out", "--iteratoins", 5)
    assert line == "snowsplat: --iteratoins: unknown flag; did you mean --iterations?"


def test_a_setting_of_another_density_control_says_so(refused, tmp_path):
    message = "a setting of McmcDensity, but this training uses AdaptiveDensity; remove it"
    with pytest.raises(SettingError, match=f"^growth: {message}"):
        recipe("paper", growth=0.1)
    out = tmp_path / "out"  # `make demo` writes the folder out
    line = refused("train", "x", "-o", out, "--recipe", "mcmc", "--percent-dense", 0.1)
    assert "--percent-dense: a setting of AdaptiveDensity, but this training uses McmcD" in line


def test_density_control_needs_what_it_needs():
    with pytest.raises(SettingError, match="^max_gaussians: 0 .* needs a limit"):
        recipe("mcmc", max_gaussians=0)
    with pytest.raises(SettingError, match="^initial_points: 0.4 is a share .* set max_gaussians"):
        recipe("default", max_gaussians=0)
    recipe("default", max_gaussians=0, initial_points=1000)
    recipe("default", max_gaussians=0, init="points", sky=False)  # which uses no initial_points


def test_numbers_of_numpy_and_lists_become_values_of_python():
    config = recipe("paper", iterations=np.int64(7), ssim_weight=np.float32(0.5))
    config = changed(config, test_iterations=[np.int32(3)], coarse_to_fine=[0.25, 5])
    assert (config.iterations, config.ssim_weight) == (7, 0.5)
    assert config.test_iterations == (3,)
    assert config.coarse_to_fine == (0.25, 5)
    assert config_from_json(json.loads(json.dumps(config_to_json(config)))) == config


def test_settings_import_neither_torch_nor_the_training():
    code = (
        "import sys, snowsplat.training.settings as s; s.recipe('paper')\n"
        "found = [m for m in sys.modules if m.startswith('snowsplat.training.')]\n"
        "assert all('.settings' in m for m in found), found\n"
        "assert not {'torch', 'numpy', 'PIL', 'tyro'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True)


def test_every_declared_setting_has_help_and_valid_defaults():
    for kind in (TrainConfig, AdaptiveDensity, McmcDensity, LearningRates, DecayRates):
        kind()
        for name, _, declared in declarations(kind):
            assert declared.help.endswith("."), name


# A density control of a user


@dataclass(frozen=True)
class Plain:
    """Not registered, and not made with `setting`."""

    abs_grad: ClassVar[bool] = False

    densify_from: int = 40
    densify_until: float = 0.7
    densify_interval: int = 40
    max_gaussians: int = 0
    share: float = 0.2

    def control(self, count, *, schedule, **_):
        return None


def test_a_plain_dataclass_of_a_user_is_a_density_control(monkeypatch):
    config = recipe("classic", density=Plain(), share=0.3, densify_interval=7)
    assert config.density == Plain(share=0.3, densify_interval=7)
    assert replace(config, density=Plain()).capped(1000, 4).density.max_gaussians == 500
    with pytest.raises(SettingError, match="^densify_interval: 0 is too small"):
        changed(config, densify_interval=0)
    with pytest.raises(SettingError, match="^density: .* has no max_gaussians"):
        recipe("classic", density=make_dataclass("Empty", [])())
    written = json.loads(json.dumps(config_to_json(config)))
    with pytest.raises(UserError, match="density control 'Plain' is not registered; name .*regis"):
        config_from_json(written)
    monkeypatch.setitem(DENSITY_CONTROLS, "Other", McmcDensity)  # restores the table
    monkeypatch.delitem(DENSITY_CONTROLS, "Other")
    assert register_density(Plain) is Plain
    monkeypatch.setitem(DENSITY_CONTROLS, "Plain", DENSITY_CONTROLS.pop("Plain"))
    assert config_from_json(written) == config


def test_starts_and_recipes_of_a_user(monkeypatch):
    for table in (STARTS, RECIPES):
        for name in list(table):
            monkeypatch.setitem(table, name, table[name])
    monkeypatch.setitem(STARTS, "laser", None)
    monkeypatch.setitem(RECIPES, "mine", None)
    register_start("laser", lambda dataset, images, count, generator: dataset.points)
    register_recipe("mine", lambda: recipe("paper", init="laser+points"))
    assert recipe("mine", seed=3).starts == ("laser", "points")
    assert TrainOptions(recipe="mine").recipe == "mine"
    with pytest.raises(ValueError, match="must not contain"):
        register_start("a+b", STARTS["laser"])


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


def test_settings_of_a_newer_version_are_ignored_with_a_warning(caplog):
    values = config_to_json(TrainConfig())
    values["decay"]["colour"] = 0.1
    assert config_from_json(values | {"gravity": 9.81}) == TrainConfig()

    assert "'gravity' is unknown to this version" in caplog.text
    assert "'colour' is unknown to this version" in caplog.text


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": "many"},
        {"iterations": None},
        {"learning_rates": 5},
        {"density": None},
        {"density": {"max_gaussians": -1}},
        {"density_control": ["AdaptiveDensity"]},
        {"test_iterations": {"a": 1}},
    ],
)
def test_a_damaged_configuration_is_refused_in_one_line(change):
    with pytest.raises(UserError, match="^the configuration: ") as error:
        config_from_json(config_to_json(TrainConfig()) | change)
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="^the configuration: damaged"):
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


def test_few_passes_have_more_steps_with_small_images():
    config = recipe("default")
    assert config.lengthened(50) == config
    assert config.staged(50) == replace(config, few_passes=0.0)
    many = config.lengthened(300)
    assert many.iterations == 3500
    staged = many.staged(300)
    assert staged.coarse_to_fine == pytest.approx((0.2, 0.5))
    assert staged.staged(1000) == staged  # it is final
    assert config.coarse_to_fine < config.capped(10**6, 130).coarse_to_fine < (0.2, 0.5)
    given = recipe("default", coarse_to_fine=(0.3, 100))
    assert given.lengthened(250).staged(250) == given
    assert recipe("classic").lengthened(250) == recipe("classic")
    of_steps = recipe("default", coarse_to_fine=(10, 0.5), few_passes=20.0)
    assert of_steps.staged(250).coarse_to_fine == pytest.approx((10, 0.6))
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
