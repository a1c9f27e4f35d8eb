"""Each benchmark starts, and those of the engine measure something real on a small workload."""

import json
import re
from pathlib import Path

import pytest

from snowsplat import Gaussians, load_dataset, ops, write_gaussians
from snowsplat.cli.main import main
from snowsplat.formats.lod import read_index
from snowsplat.ops import native, reference
from snowsplat.scene.render import project
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


def row(text: str, name: str) -> list[float]:
    (line,) = (line for line in text.splitlines() if line.startswith(name))
    return [float(cell.strip("x%")) for cell in line.removeprefix(name).split()]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("benchmarks") / "toy"
    return write_toy_dataset(folder, "colmap-bin", 9, 176, 132, n_points=400)


@pytest.fixture(scope="module")
def trained(dataset) -> Path:
    """The output folder of a training at half of the resolution."""
    out = dataset.parent / "out"
    flags = ["-r", "88", "--eval", "--iterations", "20", "--quiet"]
    assert main(["train", str(dataset), "-o", str(out), *flags]) == 0
    return out


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_script_starts(script):
    assert "usage: " in benchmark(script, "--help")


@pytest.mark.nightly
def test_stages_of_an_iteration(tmp_path):
    isa = native.available_isas()[-1]
    flags = ("--size", "tiny", "--isa", isa, "--threads", 1, "--repeats", 2)
    text = benchmark("stages.py", *flags, "--json", tmp_path / "stages.json")
    for stage in ("project: cull", "tiles: fill", "blend backward", "adam step"):
        assert min(row(text, stage)) > 0, stage
    (measured,) = json.loads((tmp_path / "stages.json").read_text())
    stages = [wall[0] for name, wall in measured["wall"].items() if name != "total"]
    assert sum(stages) == pytest.approx(measured["wall"]["total"][0])
    text = benchmark("stages.py", *flags, "--versus", ROOT / "src")
    ratio = float(next(line for line in text.splitlines() if line.startswith("total")).split()[1])
    assert 0.1 < ratio < 10  # both are the same library; the machine may be busy


def test_pairs_are_those_of_the_reference(monkeypatch):
    """The pairs are counted from the lists of the kernels and from the alphas of the reference."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("SNOWSPLAT_GARDEN", "none")
    import pairs
    import workloads

    scene = workloads.workload("tiny")
    camera = scene.camera
    splats = project(scene.gaussians, camera)
    splats.packed.requires_grad_()
    image, _, _ = ops.rasterize(splats, camera.width, camera.height)
    frame = pairs.frame_of(image)

    rows = splats.packed.detach()[splats.depths.detach().argsort(stable=True)]
    expected = 0
    for top in range(0, camera.height, 6):
        pixels = reference._pixel_centres(0, top, camera.width, 6)
        alpha, _, _ = reference._blend_weights(pixels, rows[:, :2], rows[:, 2:5], rows[:, 5])
        expected += int((alpha > 0).sum())
        # At the thresholds, the results depend on rounding.
    found = pairs.count_pairs(splats, frame, camera.width, camera.height)
    assert found == pytest.approx(expected, rel=1e-4)


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


def test_a_wrong_dataset_is_a_one_line_error(tmp_path):
    run = fork_server.run(BENCHMARKS / "train.py", tmp_path / "none")
    assert run.returncode == 1
    assert run.stderr.startswith("train: ")
    assert len(run.stderr.splitlines()) == 1


@pytest.mark.nightly
def test_a_street_in_blocks(tmp_path):
    arguments = ["blocks.py", "--out", tmp_path, "--photos", 16, "--size", 48, 32, "--blocks", 2]
    arguments += ["--gaussians", 500, "--iterations", 20, "--block-iterations", 20, "--frames", 4]
    text = benchmark(*arguments)
    whole, merged = (
        [float(cell.replace(",", "")) for cell in line.split()[1:]]
        for line in (line for line in text.splitlines() if line.startswith(("whole  ", "merged  ")))
    )
    assert whole[0] == merged[0] == 14  # every 8th of 16 is held out
    assert whole[2] > whole[3] > 0  # memory: with and without Python
    assert 8 < whole[5] < 40


def test_formats(dataset, tmp_path):
    points = load_dataset(dataset).points
    assert points is not None
    write_gaussians(tmp_path / "a.ply", Gaussians.from_points(points))
    text = benchmark(
        *("formats.py", tmp_path / "a.ply", "--dataset", dataset),
        *("--gaussians", 200, "--repeats", 1),
    )
    for name in ("compressed PLY", "SPZ", "SPZ 4", "splat"):
        size, similar = row(text, f"{name:<14}")[2:4]
        assert 0 < size < 200
        assert similar > 30


def test_scales(trained):
    cells = benchmark("scales.py", trained).splitlines()[-1].split("|")[1:-1]
    measured = json.loads((trained / "metrics.json").read_text())
    assert cells[4].strip() == f"{measured['psnr']:.2f} / {measured['ssim']:.3f}"


def test_levels_of_detail(trained, tmp_path):
    text = benchmark("lod.py", trained, "--count", 3000, "--folder", tmp_path, "--no-browser")
    assert re.search(r"convert: \d+ s, \d+ s of processor time, at most \d\.\d\d GB", text)
    assert read_index(tmp_path / "levels/lod-meta.json").counts() == [3000]
