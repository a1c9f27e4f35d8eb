"""The examples in the README work."""

import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from snowsplat.cli import main as cli
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.quality import PRESETS
from snowsplat.synthetic.toy_dataset import write_toy_dataset

from .sfm.colmap import scenes

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.slow
def test_photos_to_scene_from_python(tmp_path, monkeypatch, capsys):
    assert len(EXAMPLES[0].split("\n\n")[1].splitlines()) == 5  # "in five lines"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "draft", replace(PRESETS["draft"], iterations=60))
    scenes.write_photos(tmp_path / "photos", 7)
    example, changes = re.subn("seconds=5", "seconds=0.1", EXAMPLES[0])
    assert changes == 1
    (tmp_path / "example.py").write_text(example)
    runpy.run_path("example.py")
    psnr, scene = capsys.readouterr().out.split()
    assert float(psnr) > 12
    assert scene == "garden_scene/photos.ply"
    assert len(read_gaussians(tmp_path / "garden.spz")) == round(len(read_gaussians(scene)) / 2)
    assert (tmp_path / "garden.mp4").stat().st_size > 1000


def test_python_example_runs(tmp_path, monkeypatch, capsys):
    example = EXAMPLES[1]
    assert len(example.split("\n\n")[1].splitlines()) == 5  # "in five lines"
    monkeypatch.chdir(tmp_path)
    write_toy_dataset(tmp_path / "garden", n_views=9, width=48, height=36, n_points=300)
    quick, changes = re.subn("iterations=[0-9]+", "iterations=40", example)
    assert changes == 1
    (tmp_path / "example.py").write_text(quick)
    runpy.run_path("example.py")
    psnr, count = capsys.readouterr().out.split()
    assert float(psnr) > 15
    assert len(read_gaussians(tmp_path / "garden.ply")) == int(count)


def commands() -> list[str]:
    shown = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    lines = [line for block in shown for line in block.splitlines()]
    lines += re.findall(r"`(snowsplat (?:sfm|make|train|render|evaluate) [^`]+)`", README)
    return lines


@pytest.mark.parametrize("command", commands())
def test_command_is_valid(command):
    program, *arguments = shlex.split(command)
    assert program == "snowsplat"
    assert type(cli.parse(arguments)) is cli.load_subcommand(arguments[0])


def test_named_flags_exist(capsys):
    for name in cli.SUBCOMMANDS:
        with pytest.raises(SystemExit):
            cli.parse([name, "--help"])
    known = capsys.readouterr().out
    for flag in set(re.findall(r"`(-[-a-zA-Z_]+)", README)):
        assert flag.replace("_", "-") in known, flag


def test_linked_files_exist():
    root = Path(__file__).resolve().parents[1]
    for link in re.findall(r"\]\(([^):]+)\)", README):
        assert (root / link).exists(), link
