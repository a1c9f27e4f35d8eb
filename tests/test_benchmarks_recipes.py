"""`benchmarks/recipes.py` trains every arm once, resumes, and reports differences by seed."""

import json
import sys
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset

from . import fork_server

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import recipes
    import recipes_report
    import recipes_worker

    yield recipes, recipes_report, recipes_worker
    for name in ("recipes", "recipes_report", "recipes_worker", "plot"):
        sys.modules.pop(name, None)


def compare(tmp_path: Path, *arms: str) -> str:
    arguments = ["--datasets", tmp_path, "--captures", "toy", "absent", "--out", tmp_path / "out"]
    run = fork_server.run(
        BENCHMARKS / "recipes.py", *arms, *arguments, "--seeds", 1, "--milestones", 2
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.slow
@pytest.mark.nightly
def test_a_comparison_resumes_and_shows_the_worst_views(tmp_path):
    write_toy_dataset(tmp_path / "toy", n_views=9, width=32, height=24)
    arms = ("default:iterations=20", "classic:iterations=20,sh_degree=1")
    text = compare(tmp_path, *arms)
    assert "absent: skipped" in text
    runs = sorted((tmp_path / "out/runs").glob("*/result.json"))
    assert len(runs) == 4  # two arms, two hold-outs
    results = [json.loads(run.read_text()) for run in runs]
    assert {result["config"]["sh_degree"] for result in results} == {1, 3}
    assert all(result["pairs"] > 0 for result in results)
    assert {result["train"] for result in results} == {7, 8}
    assert [point["steps"] for point in results[0]["curve"]] == [14, 20]
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("<svg") == 2
    assert list((tmp_path / "out").glob("toy-eighth-*.png"))

    times = [run.stat().st_mtime_ns for run in runs]
    again = compare(tmp_path, *arms)
    assert [run.stat().st_mtime_ns for run in runs] == times  # nothing was trained again
    assert [line for line in again.splitlines() if line.startswith("mean")] == [
        line for line in text.splitlines() if line.startswith("mean")
    ]


def test_the_table_pairs_the_seeds(modules):
    _, report, _ = modules

    def run(arm: str, seed: int, psnr: float) -> object:
        values = {"psnr": psnr, "ssim": 0.9, "gaussians": 10, "pairs": 2.0, "seconds": 4.0}
        return report.Run("toy", "eighth", seed, arm, Path(), values)

    # Seed 2 of the second arm has no partner, so it does not count.
    runs = [run("a", 0, 20.0), run("a", 1, 22.0)]
    runs += [run("b", 0, 21.0), run("b", 1, 24.0), run("b", 2, 99.0)]
    first, second = report.rows(runs, ["a", "b"])
    assert (first.difference, first.seeds) == (0.0, 2)
    assert (second.seeds, second.psnr) == (2, 22.5)
    assert second.difference == pytest.approx(1.5)
    assert second.spread == pytest.approx(0.5**0.5)
    assert second.time_ratio == 1.0


def test_the_settings_of_an_arm(modules):
    recipes, _, _ = modules
    arm = recipes.Arm.parse("default:max_gaussians=60000,background=white,decay_opacity=0.1")
    assert arm.recipe == "default"
    assert arm.settings == {
        "max_gaussians": 60_000,
        "background": "white",
        "decay_opacity": 0.1,
    }
    with pytest.raises(Exception, match="iterations: write it as SETTING=VALUE"):
        recipes.Arm.parse("default:iterations")
