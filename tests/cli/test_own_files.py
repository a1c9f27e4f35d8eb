"""`--import FILE`: what a file of the user registers takes part in commands of a terminal."""

import json

import pytest

from snowsplat.training.parts import list as list_of_parts
from snowsplat.training.settings.recipes import RECIPES

FILE = """
import snowsplat
from snowsplat.cli.subcommands import SUBCOMMANDS, Subcommand
from snowsplat.training.settings import register_recipe

@snowsplat.register_part
class Grey(snowsplat.Part):
    def between(self, run):
        run.gaussians.sh_dc.zero_()

register_recipe("short", lambda: snowsplat.recipe("default", iterations=20))
SUBCOMMANDS["inspect-more"] = SUBCOMMANDS["info"]
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_IMPORT", "")
    monkeypatch.setattr(list_of_parts, "_REGISTERED", [])
    monkeypatch.setattr("snowsplat.cli.main.SUBCOMMANDS", commands := {})
    from snowsplat.cli import subcommands

    commands.update(subcommands.SUBCOMMANDS)
    monkeypatch.setattr(subcommands, "SUBCOMMANDS", commands)
    monkeypatch.setitem(RECIPES, "short", None)
    file = tmp_path / "my.py"
    file.write_text(FILE)
    return file


def test_parts_recipes_and_subcommands_of_a_file(run, refused, dataset, own, tmp_path, monkeypatch):
    out = tmp_path / "out"
    flags = ("--threads", 1, "--checkpoint-every", 10, "--import", own)
    result = run("train", dataset, "-o", out, "--recipe", "short", *flags)
    assert result.code == 0, result.err
    assert f"snowsplat view {out} --import {own}" in result.out
    described = json.loads(run("inspect-more", out, "--json", f"--import={own}").out)
    assert described["kind"] == "output folder"
    from snowsplat import load_trained

    assert load_trained(out).gaussians.sh_dc.abs().max() < 0.05  # after the last step
    monkeypatch.setattr(list_of_parts, "_REGISTERED", [])
    monkeypatch.setenv("SNOWSPLAT_IMPORT", "")
    error = refused("train", "-o", out, "--resume", "--iterations", 30)
    assert "part 'Grey'" in error
    assert "--import FILE" in error


def test_files_that_are_refused(refused, own, tmp_path):
    assert "is no Python file" in refused("info", tmp_path, "--import", tmp_path / "none.py")
    assert "is no Python file" in refused("info", tmp_path, "--import", tmp_path)
    own.write_text("x = 1\ny = = 2\n")
    assert f"{own}, line 2: invalid syntax" in refused("info", tmp_path, "--import", own)
    settings = tmp_path / "settings.json"
    settings.write_text(json.dumps({"import": str(own)}))
    assert "import: unknown" in refused("train", tmp_path, "-o", "out", "--config", settings)
