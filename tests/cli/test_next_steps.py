"""What a command says to do next, and what is said about words that are no subcommand."""

import re
from pathlib import Path

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.cli.command import next_step, see_and_share
from snowsplat.cli.main import SUBCOMMANDS
from snowsplat.cli.subcommands import known_words
from snowsplat.formats import write_gaussians
from snowsplat.util import messages
from snowsplat.util.messages import message


@pytest.fixture
def scene(tmp_path) -> Path:
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    write_gaussians(tmp_path / "box.ply", gaussians_in_box(box, 200, torch.Generator()))
    return tmp_path / "box.ply"


def test_commands_are_quoted():
    assert (
        str(next_step(message("or"), "info", Path("my garden"))) == "or: snowsplat info 'my garden'"
    )
    assert str(see_and_share(Path("walk_scene"))) == (
        "to see it: snowsplat view walk_scene; "
        "to share it: snowsplat publish walk_scene -o walk_site"
    )
    assert str(see_and_share(Path("out/a.compressed.ply"))).endswith("-o a_site")


def test_words_that_are_no_subcommand(refused, scene, monkeypatch):
    assert "use convert (a file in another format) or publish" in refused("export")
    assert "publish" in refused("share")
    assert "use points (a dense cloud), or mesh" in refused("pointcloud")
    assert f"snowsplat view {scene}; or: snowsplat info {scene}" in refused(scene)
    for hint, words in known_words().items():
        assert re.match(r"use (\w+)", hint)[1] in SUBCOMMANDS
        assert not set(words.split()) & set(SUBCOMMANDS)


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.html", "levels/lod-meta.json"])
def test_convert_makes_folders_and_says_what_is_next(run, scene, monkeypatch, name):
    monkeypatch.chdir(scene.parent)
    target = f"new/deep/{name}"
    result = run("convert", "box.ply", target)
    assert (result.code, result.err) == (0, "")
    first, last = result.out.splitlines()[-2:]
    assert re.match(rf"{target}: [\d.]+ [kM]B of ", first)
    page = f"open {target} in a browser"
    assert last.startswith(f"to see it: {page if name == 'a.html' else 'snowsplat view'}")


def test_an_unwritable_target_is_named_without_its_temporary_file(refused, scene, monkeypatch):
    monkeypatch.chdir(scene.parent)
    assert "box.ply/a.spz: a part of its folder is a file" in refused(
        "convert", "box.ply", "box.ply/a.spz"
    )

    def fails(*_, **__):
        raise FileNotFoundError(2, "No such file or directory", f"{scene.parent}/.a.spz.x1y2.tmp")

    monkeypatch.setattr("snowsplat.util.files.tempfile.mkstemp", fails)
    monkeypatch.setattr("snowsplat.util.files.fcntl", None)
    assert refused("convert", "box.ply", "a.spz") == "snowsplat: a.spz: No such file or directory"


def test_info_tells_sizes_and_what_is_next(run, scene):
    lines = run("info", scene).out.splitlines()
    assert [line for line in lines if re.match(r"size +\d+ kB$", line)]
    assert lines[-1].startswith("to see it: snowsplat view ")


def test_info_in_chinese(run, scene, monkeypatch):
    """Chinese characters take two columns."""
    monkeypatch.setattr(messages, "_current", messages.language())  # it is restored at the end
    monkeypatch.setenv("LC_ALL", "zh_CN.UTF-8")
    lines = run("info", scene).out.splitlines()
    assert lines[0].split() == ["种类", "场景"]
    assert not [line for line in lines if re.match("[a-z]+ ", line)]
    before = [re.split(r"(?<=\S) +(?=\S)", line)[0] for line in lines[:3]]
    starts = [
        2 * len(label) + len(line) - len(line[len(label) :].lstrip()) - len(label)
        for label, line in zip(before, lines, strict=False)
    ]
    assert len(set(starts)) == 1
