"""`snowsplat benchmark`: protocols, tables, interrupted and failed scenes, locks."""

import csv
import json
import math
import os
import re
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from snowsplat.pipeline.benchmark import run as benchmark_run
from snowsplat.pipeline.benchmark.benchmark_page import BenchmarkReport, write_report
from snowsplat.pipeline.benchmark.job import SUITES, Job, SceneResult, suite_of
from snowsplat.pipeline.options.benchmark import BenchmarkOptions
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError

from ..fork_server import popen
from ..fork_server import run as started

BENCHMARK = ("-m", "snowsplat", "benchmark")
FLAGS = ("--iterations", "60", "--jobs", "2")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """Two scenes of the suite blender, and a folder that is not a scene."""
    folder = tmp_path_factory.mktemp("benchmark") / "scenes"
    (folder / "notes").mkdir(parents=True)
    for name in ("lego", "ship"):
        write_toy_dataset(folder / name, "colmap-bin", 9, 48, 36, n_points=300)
    return folder


@pytest.fixture(scope="module")
def finished(scenes) -> Path:
    """The results of the two scenes."""
    out = scenes.parent / "out"
    result = started(*BENCHMARK, scenes, "-o", out, *FLAGS, forks=True)
    assert result.returncode == 0, result.stderr
    return out


@pytest.mark.slow
def test_results(finished):
    with (finished / "results.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["scene"] for row in rows] == ["lego", "ship"]
    assert float(rows[0]["psnr"]) > 10
    assert float(rows[0]["published_psnr"]) == 35.78
    values = json.loads((finished / "results.json").read_text(encoding="utf-8"))
    assert values["suite"] == "blender"
    first = values["results"][0]
    assert first["psnr"] == float(rows[0]["psnr"])
    assert first["job"]["settings"] == {"background": "white", "iterations": 60}
    assert first["photos"] == [7, 2]  # every 8th of nine, as they have no split of their own
    assert first["seconds"] > 0
    assert first["memory"] > 1e8
    metrics = json.loads((finished / "lego" / "metrics.json").read_text(encoding="utf-8"))
    assert first["psnr"] == pytest.approx(metrics["psnr"])
    assert min(metrics["views"], key=lambda name: metrics["views"][name]["psnr"]) == first["worst"]
    assert Image.open(finished / "lego" / "worst.jpg").size == (96, 36)
    text = (finished / "index.html").read_text(encoding="utf-8")
    assert "<h1>Blender (NeRF synthetic)</h1>" in text
    assert text.count("data:image/jpeg") == 2
    assert "35.78" in text
    latex = (finished / "results.tex").read_text(encoding="utf-8")
    assert latex.count(r" \\") == 4  # titles, two scenes, mean
    assert not list(finished.glob("*.lock"))


@pytest.mark.slow
def test_finished_scenes_are_not_repeated(run, refused, scenes, finished):
    before = [(finished / name / "benchmark.json").stat().st_mtime_ns for name in ("lego", "ship")]
    result = run("benchmark", scenes, "-o", finished, *FLAGS)
    assert result.code == 0, result.err
    assert "2 scenes, 2 finished" in result.out
    assert re.search(r"^mean +\d", result.out, re.MULTILINE)
    after = [(finished / name / "benchmark.json").stat().st_mtime_ns for name in ("lego", "ship")]
    assert after == before
    assert "other settings" in refused("benchmark", scenes, "-o", finished, "--iterations", 61)


@pytest.mark.slow
def test_a_scene_that_fails_does_not_stop_the_others(scenes, tmp_path):
    for name in ("lego", "ship"):
        (tmp_path / "scenes").mkdir(exist_ok=True)
        (tmp_path / "scenes" / name).symlink_to(scenes / name)
    (tmp_path / "scenes" / "mic" / "sparse").mkdir(parents=True)
    only = ("--scenes", "mic", "lego")
    arguments = (tmp_path / "scenes", "-o", tmp_path / "out", *FLAGS, *only)
    result = started(*BENCHMARK, *arguments, forks=True)
    assert result.returncode == 2
    assert re.search(r"^mic: .*sparse", result.stdout, re.MULTILINE)
    rows = (tmp_path / "out" / "results.csv").read_text(encoding="utf-8").splitlines()
    assert [row.split(",")[0] for row in rows] == ["scene", "lego"]
    assert "mic: " in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_killed_and_called_again(scenes, finished, tmp_path):
    """The process of the scene ends with the one that was killed; the result is the same."""
    out = tmp_path / "out"
    command = (*BENCHMARK, scenes, "-o", out, "--iterations", "60")
    command += ("--scenes", "lego", "--suite", "blender")
    killed = popen(*command, forks=True)
    lock = out / "lego.lock"
    while not lock.exists():
        assert killed.poll() is None
        time.sleep(0.02)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    again = started(*command, forks=True)
    assert again.returncode == 0, again.stderr
    first, second = (
        json.loads((folder / "lego" / "benchmark.json").read_text(encoding="utf-8"))
        for folder in (finished, out)
    )
    assert first["psnr"] == second["psnr"]
    assert not lock.exists()


def test_suites():
    assert suite_of(["bicycle", "room"]) == "mipnerf360"
    assert suite_of(["truck"]) == "tandt"
    assert suite_of(["playroom", "drjohnson"]) == "db"
    assert suite_of(["lego", "mic"]) == "blender"
    assert suite_of(["lego", "room"]) == "custom"
    assert suite_of([]) == "custom"
    assert SUITES["mipnerf360"].resolutions["garden"] == 4
    assert SUITES["mipnerf360"].resolutions["bonsai"] == 2
    job = benchmark_run._job(Path("garden"), Path("out"), "mipnerf360", BenchmarkOptions())
    assert (job.resolution, job.imports) == (4, [])


@pytest.mark.parametrize(
    ("suite", "psnr", "ssim", "lpips"),
    [
        ("mipnerf360", 27.21, 0.815, 0.214),
        ("tandt", 23.14, 0.841, 0.183),
        ("db", 29.41, 0.903, 0.243),
        ("blender", 33.32, None, None),
    ],
)
def test_published_figures_have_the_published_means(suite, psnr, ssim, lpips):
    """Table 1 and table 2 of the paper list the means of the tables of its supplement."""
    published = SUITES[suite].published.values()
    for name, mean, digit in (("psnr", psnr, 0.01), ("ssim", ssim, 0.001), ("lpips", lpips, 0.001)):
        if mean is not None:
            values = [getattr(figures, name) for figures in published]
            assert math.fsum(values) / len(values) == pytest.approx(mean, abs=digit)


def test_tables_escape_names(tmp_path):
    job = Job("a_<b>&", str(tmp_path), str(tmp_path / "a_<b>&"), "default")
    result = SceneResult(job, 30.0, 0.9, None, 1000, 60.0, 10**9, (7, 1), (8, 6), "x.png", "A & B")
    Path(job.output).mkdir()
    Image.new("RGB", (16, 6)).save(Path(job.output) / "worst.jpg")
    other = replace(result, job=replace(job), psnr=32.0)
    write_report(tmp_path, BenchmarkReport("custom", [result, other], {"c": "c: <failed>"}))
    latex = (tmp_path / "results.tex").read_text(encoding="utf-8")
    assert r"a\_<b>\& & 30.00 & 0.9000 & 1,000" in latex
    assert "mean & 31.00" in latex
    assert "published" not in latex
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "a_&lt;b&gt;&amp;" in text
    assert "<b>" not in text
    assert "<failed>" not in text


def test_errors(refused, tmp_path):
    out = ("-o", tmp_path / "out")
    assert "needs a folder that contains" in refused("benchmark")
    assert "add -o OUT" in refused("benchmark", tmp_path)
    assert "no such folder" in refused("benchmark", tmp_path / "absent", *out)
    assert "contains no folders of datasets" in refused("benchmark", tmp_path, *out)
    write_toy_dataset(tmp_path / "scenes" / "a", "colmap-bin", 3, 16, 12, n_points=30)
    assert "use the folder above" in refused("benchmark", tmp_path / "scenes" / "a", *out)
    scenes = ("benchmark", tmp_path / "scenes", *out)
    assert "contains no dataset b" in refused(*scenes, "--scenes", "b")
    assert "--jobs: 0 is too small" in refused(*scenes, "--jobs", 0)
    assert "--lpips" in refused(*scenes, "--lpips", tmp_path / "absent.safetensors")
    with pytest.raises(UserError, match="unknown"):
        BenchmarkOptions(suite="other")
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "benchmark.json").write_text("{}", encoding="utf-8")
    assert "is damaged" in refused(*scenes)
