"""Each benchmark starts, and that of the training measures something real."""

import json
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset

from . import fork_server

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
SCRIPTS = sorted(
    file.name for file in BENCHMARKS.glob("*.py") if "ArgumentParser(" in file.read_text()
)

pytestmark = pytest.mark.slow


def benchmark(script: str, *arguments: object) -> str:
    """The output of a script. It never uses the garden, so it is the same everywhere."""
    # Threads of PyTorch that wait for each other leave the processor to other tests.
    environment = fork_server.ENVIRONMENT | {
        "SNOWSPLAT_GARDEN": "none",
        "OMP_WAIT_POLICY": "passive",
    }
    run = fork_server.run(BENCHMARKS / script, *arguments, env=environment)
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("benchmarks") / "toy"
    return write_toy_dataset(folder, "colmap-bin", 9, 176, 132, n_points=400)


HELP = """
import contextlib, io, runpy, sys
_, folder, *scripts = sys.argv
sys.path.insert(0, folder)
for script in scripts:
    sys.argv = [script, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            runpy.run_path(f"{folder}/{script}", run_name="__main__")
        except SystemExit as end:
            assert not end.code, (script, end.code)
    assert "usage: " in out.getvalue(), script
    print(script)
"""


def test_every_script_starts():
    """In one process, which imports what they share once."""
    run = fork_server.run("-c", HELP, BENCHMARKS, *SCRIPTS)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == SCRIPTS


def test_psnr_against_time(dataset, tmp_path):
    benchmark(
        *("train.py", dataset, "-o", tmp_path, "--iterations", 20, "--milestones", 2),
        *("--recipe", "default", "--set", "max_gaussians=300"),
    )
    first, last = json.loads((tmp_path / "toy.json").read_text())["rows"]
    assert 0 < first["seconds"] < last["seconds"]
    assert last["psnr"] > 5
    assert last["peak_mb"] > 50
    assert (tmp_path / "toy.svg").is_file()
