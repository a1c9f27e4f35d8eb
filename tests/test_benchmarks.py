"""The benchmarks run, on workloads small enough for a test, and count what they say they count."""

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torch

from snowsplat import Gaussians, load_capture, ops, write_gaussians
from snowsplat.capture.synthetic import write_synthetic_capture
from snowsplat.ops import native, reference

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"


def benchmark(script: str, *arguments: object) -> str:
    """What the script prints. Without the garden's points, so that it is the same everywhere."""
    environment = os.environ | {"SNOWSPLAT_GARDEN": "none", "PYTHONPATH": str(ROOT / "src")}
    run = subprocess.run(
        [sys.executable, str(BENCHMARKS / script), *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def row(text: str, name: str) -> list[float]:
    (line,) = (line for line in text.splitlines() if line.startswith(name))
    return [float(cell.strip("x%")) for cell in line.removeprefix(name).split()]


def test_stages_of_an_iteration(tmp_path):
    isa = native.available_isas()[-1]
    file = tmp_path / "stages.json"
    text = benchmark(
        "stages.py",
        "--size",
        "tiny",
        "--isa",
        isa,
        "--repeats",
        2,
        "--twin",
        "tiny",
        "--json",
        file,
    )
    assert "procedural courtyard" in text
    assert f"{isa} x1" in text
    for stage in ("project: cull", "tiles: fill", "blend backward", "adam step", "total"):
        values = row(text, stage)
        assert len(values) == 6, stage  # min, median, cpu for 1 thread and for 2
        assert min(values) > 0, stage
    twin, own, ratio, _ = row(text, "1 thread ")
    assert ratio == pytest.approx(twin / own, rel=0.1)
    assert ratio > 1

    one_thread = json.loads(file.read_text())[0]
    wall, counts = one_thread["wall"], one_thread["counts"]
    unknown = wall.keys() - {"total"}
    assert sum(wall[name][0] for name in unknown) == pytest.approx(wall["total"][0])
    assert 0 < counts["pairs"] <= counts["lanes"] * counts["steps"]
    assert 0 < one_thread["lane_use"] <= 1
    assert row(text, "  floor, ns")[0] == pytest.approx(one_thread["floor_ns"], abs=0.01)


def test_two_libraries_in_turns():
    text = benchmark(
        *("stages.py", "--size", "tiny", "--threads", 1, "--repeats", 2),
        *("--isa", "baseline", "--versus", ROOT / "src"),
    )
    total = next(line for line in text.splitlines() if line.startswith("total"))
    median = float(total.split()[1])
    assert 0.1 < median < 10  # the same library on both sides, on a machine that may be busy


def test_pairs_are_those_of_the_twin(monkeypatch):
    """Counted from the kernels' lists, and from the twin's alphas without any list."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("SNOWSPLAT_GARDEN", "none")
    import pairs
    import workloads

    scene = workloads.workload("tiny")
    camera = scene.camera
    splats = ops.project(
        **scene.gaussians.parameters(),
        cam_from_world=camera.cam_from_world,
        **{k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")},
        sh_degree=3,
    )
    splats.packed.requires_grad_()
    image, _, _ = ops.rasterize(splats, camera.width, camera.height)
    frame = pairs.frame_of(image)

    rows = splats.packed.detach()[splats.depths.detach().argsort(stable=True)]
    expected = 0
    for top in range(0, camera.height, 6):
        pixels = reference._pixel_centres(0, top, camera.width, 6)
        alpha, _, _ = reference._blend_weights(pixels, rows[:, :2], rows[:, 2:5], rows[:, 5])
        expected += int((alpha > 0).sum())
    # At the very thresholds the last bit decides.
    found = pairs.count_pairs(splats, frame, camera.width, camera.height)
    assert found == pytest.approx(expected, rel=1e-4)
    counts = pairs.count_steps(frame)
    assert counts["visited"] <= counts["instances"]
    assert found <= pairs.LANES[native.isa()] * counts["steps"]


def test_psnr_against_time(tmp_path):
    capture = tmp_path / "balls"
    with torch.random.fork_rng():
        write_synthetic_capture(capture, n_views=9, width=48, height=36, n_points=200)
    text = benchmark(
        *("train.py", capture, "-o", tmp_path, "--iterations", 40, "--milestones", 3),
        *("--recipe", "default", "paper", "--set", "max_gaussians=300"),
    )
    first, *_, last = (line.split() for line in text.splitlines() if line.startswith("default"))
    assert (int(first[1]), int(last[1])) == (20, 40)
    rows = json.loads((tmp_path / "balls.json").read_text())["rows"]
    assert [row["recipe"] for row in rows] == ["default"] * 3 + ["paper"] * 3
    assert 0 < rows[0]["seconds"] < rows[1]["seconds"] < rows[2]["seconds"]
    assert all(row["psnr"] > 5 and row["peak_mb"] > 50 for row in rows)
    assert len((tmp_path / "balls.csv").read_text().splitlines()) == 7
    chart = ElementTree.parse(tmp_path / "balls.svg").getroot()
    lines = chart.findall("{http://www.w3.org/2000/svg}polyline")
    assert [len(line.attrib["points"].split()) for line in lines] == [3, 3]


def test_a_wrong_capture_is_one_line(tmp_path):
    run = subprocess.run(
        [sys.executable, str(BENCHMARKS / "train.py"), str(tmp_path / "none")],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 1
    assert run.stderr.startswith("train: ")
    assert len(run.stderr.splitlines()) == 1


def test_formats(tmp_path):
    write_synthetic_capture(tmp_path / "capture", "colmap-bin", 9, 32, 24, n_points=60)
    points = load_capture(tmp_path / "capture").points
    assert points is not None
    write_gaussians(tmp_path / "a.ply", Gaussians.from_points(points))
    text = benchmark(
        "formats.py",
        tmp_path / "a.ply",
        *("--capture", tmp_path / "capture", "--gaussians", 200, "--repeats", 1),
    )
    assert "times of 200; 2 views" in text
    assert row(text, "PLY")[2:4] == [pytest.approx(248, abs=30), float("inf")]
    for name in ("compressed PLY", "SPZ", "SPZ 4", "splat"):
        size, similar = row(text, f"{name:<14}")[2:4]
        assert 0 < size < 200
        assert similar > 30
