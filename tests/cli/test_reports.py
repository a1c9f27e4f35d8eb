"""`--json`: one JSON value on stdout, and all other lines on stderr."""

import json
import math
from dataclasses import fields
from pathlib import Path

import pytest

from snowsplat.cli.command import plain
from snowsplat.cli.subcommands import SUBCOMMANDS, load_subcommand
from snowsplat.evaluation.metrics import Evaluation
from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.util.messages import message

#: They serve pages, or run others of these commands.
WITHOUT = {"studio", "view", "watch", "demo", "blocks"}


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("reports") / "out"


def test_every_command_that_reports_has_the_flag():
    having = {
        name
        for name in SUBCOMMANDS
        if "json" in {each.name for each in fields(load_subcommand(name))}
    }
    assert having == set(SUBCOMMANDS) - WITHOUT


def test_train_and_what_follows(run, dataset, out, tmp_path):
    def report(*arguments):
        result = run(*arguments, "--json")
        assert result.code == 0, result.err
        return json.loads(result.out), result.err

    trained, lines = report("train", dataset, "-o", out, "--iterations", 20, "--eval")
    assert "the report of the training" in lines
    assert trained["scene"] == str(out / "point_cloud/iteration_20/point_cloud.ply")
    assert trained["evaluation"]["step"] == 20
    evaluated, lines = report("evaluate", out)
    assert "mean" in lines
    assert evaluated["psnr"] == trained["evaluation"]["psnr"]
    assert evaluated["split"] == "test"
    several, _ = report("evaluate", "-m", out, out)
    assert [each["psnr"] for each in several] == [evaluated["psnr"]] * 2
    converted, _ = report("convert", out, tmp_path / "a.spz")
    assert (converted["format"], converted["bytes"]) == ("SPZ", (tmp_path / "a.spz").stat().st_size)
    cleaned, _ = report("clean", out, tmp_path / "b.ply")
    assert cleaned["before"] >= cleaned["after"]
    published, _ = report("publish", out, "-o", tmp_path / "site")
    assert published["gaussians"] == trained["gaussians"]
    rendered, _ = report("render", out, "--split", "test")
    assert list(rendered["images"].values()) == [len(evaluated["views"])]


def test_an_error_prints_nothing_on_stdout(run, tmp_path):
    result = run("evaluate", tmp_path / "absent", "--json")
    assert (result.code, result.out) == (2, "")
    assert result.err.count("\n") == 1


def test_values():
    assert plain({"a": (Path("x"), math.nan, None, True)}) == {"a": ["x", None, None, True]}
    assert plain(Evaluation([]))["psnr"] is None


def test_messages_are_texts_in_json():
    verdict = Verdict.of([Reason("poor", message("{n} photos are few", n=3))])
    (reason,) = plain({"verdict": verdict})["verdict"]["reasons"]
    assert reason["text"] == "3 photos are few"
    assert plain(message("at most {peak} MB", peak=5)) == "at most 5 MB"
