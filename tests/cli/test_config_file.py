"""`--config FILE`: flags in a file, the config.json of an earlier training, and what is refused."""

import json
import sys
from pathlib import Path

import pytest

from snowsplat.cli.main import parse

TOML = pytest.param(
    "f.toml",
    """
    iterations = 300
    white-background = true
    antialias = false
    allow_host = ["a.example", "b.example"]
    test_iterations = [-1]
    lambda_dssim = 0.3
    quiet = false
    """,
    marks=pytest.mark.skipif(sys.version_info < (3, 11), reason="no tomllib"),
)
JSON = (
    "f.json",
    """{"iterations": 300, "white_background": true, "antialias": false, "allow-host":
    ["a.example", "b.example"], "test_iterations": [-1], "lambda_dssim": 0.3, "quiet": false,
    "minutes": null}""",
)


@pytest.mark.parametrize(("name", "text"), [JSON, TOML])
def test_flags_in_a_file(tmp_path, name, text):
    file = tmp_path / name
    file.write_text(text)
    flags = parse(["train", "garden", "--config", str(file), "-o", "out", "--allow-host", "c.de"])
    assert (flags.dataset, flags.output, flags.config) == (Path("garden"), Path("out"), None)
    assert (flags.white_background, flags.quiet) == (True, False)
    assert flags.options.settings == {
        "iterations": 300,
        "antialias": False,
        "test_iterations": (-1,),
        "ssim_weight": 0.3,
    }
    assert flags.address.allow_host == ("c.de",)  # the flag has priority
    again = parse(["train", "g", "-o", "out", f"--config={file}", "--iterations", "7"])
    assert again.options.settings["iterations"] == 7


def test_flags_of_make_in_a_file(tmp_path):
    (tmp_path / "f.json").write_text('{"quality": "draft", "output": "-x"}')
    flags = parse(["make", "a.jpg", "b.jpg", "--config", str(tmp_path / "f.json")])
    assert (flags.options.quality, flags.output, len(flags.inputs)) == ("draft", Path("-x"), 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"iteration": 3}', "iteration: unknown; did you mean iterations?"),
        ('{"dataset": "garden"}', "dataset: unknown"),
        ('{"config": "other.json"}', "config: unknown"),
        ('{"eval": "yes"}', "eval: use true or false"),
        ('{"iterations": {"a": 1}}', "iterations: a table"),
        ('{"iterations": "many"}', "--iterations: 'many' has the wrong type; use a whole number"),
        ("[1]", "no names of flags"),
        ("{", "neither JSON nor"),
        ('{"training": {"density_control": "AdaptiveDensity"}, "x": 1}', "x: unknown"),
        ('{"training": {"density_control": "AdaptiveDensity", "a": 1}}', "'a' is unknown"),
    ],
)
def test_what_is_refused_in_one_line(refused, dataset, tmp_path, text, message):
    (tmp_path / "f.json").write_text(text)
    line = refused("train", dataset, "-o", tmp_path / "out", "--config", tmp_path / "f.json")
    assert message in line
    assert not (tmp_path / "out").exists()


def test_a_missing_file_and_a_missing_value(refused, tmp_path):
    assert "absent.json" in refused("train", "g", "-o", "o", "--config", tmp_path / "absent.json")
    assert "--config: needs a value" in refused("train", "g", "-o", "o", "--config")
    (tmp_path / "config.json").write_text('{"training": {}}')
    assert "use it with train" in refused("make", "g", "--config", tmp_path / "config.json")


def test_the_settings_of_an_earlier_training(run, refused, dataset, tmp_path):
    first, again, other = (tmp_path / name for name in ("first", "again", "other"))
    flags = ["--recipe", "mcmc-short", "--iterations", 20, "--max-gaussians", 700, "--eval"]
    flags += ["--init", "points", "--seed", 3]
    assert run("train", dataset, "-o", first, *flags).code == 0
    earlier = first / "config.json"
    assert run("train", "--config", earlier, "-o", again).code == 0  # the same dataset
    name = "point_cloud/iteration_20/point_cloud.ply"
    assert (first / name).read_bytes() == (again / name).read_bytes()
    one, two = (json.loads((out / "config.json").read_text()) for out in (first, again))
    assert one == two
    assert run("train", dataset, "--config", earlier, "-o", other, "--seed", 4).code == 0
    three = json.loads((other / "config.json").read_text())
    assert three["training"] == one["training"] | {"seed": 4}
    line = refused("train", "--config", earlier, "-o", tmp_path / "x", "--recipe", "paper")
    assert "leave one out" in line
