"""The benchmarks run on small workloads, and their counts are correct."""

import argparse
import json
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torch
from PIL import Image

from snowsplat import Gaussians, load_dataset, ops, write_gaussians
from snowsplat.cli.main import main
from snowsplat.formats.lod import read_index
from snowsplat.ops import native, reference
from snowsplat.ops.cuda.launches import KERNELS, launch_by
from snowsplat.ops.native import LAUNCHERS
from snowsplat.scene.render import project
from snowsplat.synthetic.toy_dataset import write_toy_dataset

from . import fork_server

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
#: A sleep duration that no other process uses, which identifies the children of these tests.
LONG = 70 + os.getpid() * 1e-7


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
        "--reference",
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
    slow, own, ratio, _ = row(text, "1 thread ")
    assert ratio == pytest.approx(slow / own, rel=0.1)
    assert ratio > 1

    one_thread = json.loads(file.read_text())[0]
    wall, counts = one_thread["wall"], one_thread["counts"]
    unknown = wall.keys() - {"total"}
    assert sum(wall[name][0] for name in unknown) == pytest.approx(wall["total"][0])
    assert 0 < counts["pairs"] <= counts["lanes"] * counts["steps"]
    assert 0 < one_thread["lane_use"] <= 1
    assert row(text, "  floor, ns")[0] == pytest.approx(one_thread["floor_ns"], abs=0.01)


def test_two_libraries_are_measured_alternately():
    text = benchmark(
        *("stages.py", "--size", "tiny", "--threads", 1, "--repeats", 2),
        *("--isa", "baseline", "--versus", ROOT / "src"),
    )
    total = next(line for line in text.splitlines() if line.startswith("total"))
    median = float(total.split()[1])
    assert 0.1 < median < 10  # both are the same library; the machine may be busy


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
    counts = pairs.count_steps(frame)
    assert counts["visited"] <= counts["instances"]
    assert found <= pairs.LANES[native.isa()] * counts["steps"]


def test_psnr_against_time(tmp_path):
    dataset = tmp_path / "balls"
    with torch.random.fork_rng():
        write_toy_dataset(dataset, n_views=9, width=48, height=36, n_points=200)
    text = benchmark(
        *("train.py", dataset, "-o", tmp_path, "--iterations", 40, "--milestones", 3),
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


def test_a_wrong_dataset_is_a_one_line_error(tmp_path):
    run = fork_server.run(BENCHMARKS / "train.py", tmp_path / "none")
    assert run.returncode == 1
    assert run.stderr.startswith("train: ")
    assert len(run.stderr.splitlines()) == 1


def test_a_street_in_blocks(tmp_path):
    arguments = ["blocks.py", "--out", tmp_path, "--photos", 16, "--size", 48, 32, "--blocks", 2]
    arguments += ["--gaussians", 500, "--iterations", 20, "--block-iterations", 20, "--frames", 4]
    text = benchmark(*arguments)
    whole, merged = (
        [float(cell.replace(",", "")) for cell in line.split()[1:]]
        for line in (line for line in text.splitlines() if line.startswith(("whole  ", "merged  ")))
    )
    assert whole[0] == merged[0] == 14  # every 8th of 16 is held out
    assert whole[1] == 500
    assert whole[2] > whole[3] > 0  # memory: with and without Python
    assert 8 < whole[5] < 40
    assert whole[5:] == merged[5:]
    with Image.open(tmp_path / "worst.png") as pictures:
        assert pictures.size == (3 * 48, 2 * 32)
    assert (tmp_path / "film.mp4").stat().st_size > 500


def test_formats(tmp_path):
    write_toy_dataset(tmp_path / "dataset", "colmap-bin", 9, 32, 24, n_points=60)
    points = load_dataset(tmp_path / "dataset").points
    assert points is not None
    write_gaussians(tmp_path / "a.ply", Gaussians.from_points(points))
    text = benchmark(
        "formats.py",
        tmp_path / "a.ply",
        *("--dataset", tmp_path / "dataset", "--gaussians", 200, "--repeats", 1),
    )
    assert "times of 200; 2 views" in text
    assert row(text, "PLY")[2:4] == [pytest.approx(248, abs=30), float("inf")]
    for name in ("compressed PLY", "SPZ", "SPZ 4", "splat"):
        size, similar = row(text, f"{name:<14}")[2:4]
        assert 0 < size < 200
        assert similar > 30


def test_scales(tmp_path):
    dataset = write_toy_dataset(tmp_path / "dataset", "colmap-bin", 9, 192, 144, n_points=60)
    flags = ["-r", "96", "--eval", "--iterations", "20", "--quiet"]
    assert main(["train", str(dataset), "-o", str(tmp_path / "out"), *flags]) == 0
    cells = benchmark("scales.py", tmp_path / "out").splitlines()[-1].split("|")[1:-1]
    measured = json.loads((tmp_path / "out/metrics.json").read_text())
    assert cells[0].strip() == "out"
    assert cells[4].strip() == f"{measured['psnr']:.2f} / {measured['ssim']:.3f}"
    assert all(float(cells[i].split("/")[0]) > 5 for i in (2, 3, 5))
    assert cells[6].strip() == "-"  # larger than the photos


# ------------------------------------------------------------------------------------------ gpu.py


@pytest.fixture
def gpu_modules(monkeypatch):
    """The modules beside gpu.py, which can then be imported by name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("SNOWSPLAT_GARDEN", "none")


def run_jobs(folder, *jobs, seconds=60.0, width=4):
    import gpu_jobs

    found, log = [], folder / "log"
    log.write_bytes(b"")
    runner = gpu_jobs.Runner(
        folder,
        log,
        time.monotonic() + seconds,
        width,
        lambda job, one: found.append((job, one)),
        say=lambda line: None,
    )
    runner.run(jobs)
    return {outcome.job: outcome for outcome in runner.outcomes}, found, log.read_text()


def job(name, code, limit=30.0, **more):
    import gpu_jobs

    return gpu_jobs.Job(name, [sys.executable, "-c", code], limit, **more)


def test_without_a_gpu_it_prints_one_line(tmp_path):
    environment = fork_server.ENVIRONMENT | {"CUDA_VISIBLE_DEVICES": ""}
    run = fork_server.run(BENCHMARKS / "gpu.py", "--out", tmp_path / "out", env=environment)
    assert run.returncode == 2
    assert len(run.stdout.splitlines()) == 1
    assert run.stdout.startswith("gpu: nothing was measured: ")
    assert run.stderr == ""
    assert not (tmp_path / "out").exists()


def test_a_job_that_crashes_or_hangs_does_not_affect_others(gpu_modules, tmp_path):
    report = 'print(\'@@ {"kind": "x", "value": 1}\', flush=True); '
    outcomes, found, log = run_jobs(
        tmp_path,
        job("a child of its own", f"import subprocess; subprocess.run(['sleep', '{LONG}'])", 1.0),
        job("late", report + "import time; time.sleep(60)", limit=1.5),
        job("crash", report + "import os; print('last words', flush=True); os.abort()"),
        job("error", report + "raise ValueError('what was wrong')"),
        job("no program", ""),
        job("normal", report + "print('@@ not json'); print('@@ {\"half', end='')"),
    )
    states = {name: outcome.state for name, outcome in outcomes.items()}
    assert states == {
        "a child of its own": "late",
        "late": "late",
        "crash": "failed",
        "error": "failed",
        "no program": "done",
        "normal": "done",
    }
    assert outcomes["crash"].reason == "SIGABRT; last words"
    assert outcomes["error"].reason == "ValueError: what was wrong"
    assert outcomes["late"].reason == "ended after 2 s"
    assert 1.5 <= outcomes["late"].seconds < 10
    # Their earlier findings are not lost.
    assert sorted(name for name, _ in found) == ["crash", "error", "late", "normal"]
    assert "===== crash: failed" in log
    assert "last words" in log
    assert "kind" not in log
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout
    assert f"sleep {LONG}" not in running


def test_timed_jobs_run_alone_and_no_job_starts_too_late(gpu_modules, tmp_path):
    note = (
        "import time, pathlib; p = pathlib.Path(r'{}'); a = time.time(); time.sleep(0.4); "
        "f = p.open('a'); f.write(f'{} {{a}} {{time.time()}}\\n')"
    )
    path = tmp_path / "times"
    together = [job(f"together {i}", note.format(path, f"t{i}")) for i in range(3)]
    alone = [job(f"alone {i}", note.format(path, f"a{i}"), alone=True) for i in range(2)]
    outcomes, _, _ = run_jobs(
        tmp_path, *together, *alone, job("never", "", least=1000.0), job("missing", "", 5.0)
    )
    lines = map(str.split, path.read_text().splitlines())
    spans = {name: (float(a), float(b)) for name, a, b in lines}
    assert len(spans) == 5
    for name in ("a0", "a1"):
        begin, end = spans[name]
        others = [span for other, span in spans.items() if other != name]
        assert all(b <= begin or a >= end for a, b in others)
    assert max(spans[f"t{i}"][0] for i in range(3)) < min(spans[f"t{i}"][1] for i in range(3))
    assert outcomes["never"].state == "not run"
    outcomes, _, _ = run_jobs(
        tmp_path, job("cut", "import time; time.sleep(60)", least=0.0), seconds=1
    )
    assert outcomes["cut"].state == "late"
    import gpu_jobs

    outcomes, _, _ = run_jobs(tmp_path, gpu_jobs.Job("absent", ["/no/such/program"], 5.0))
    assert outcomes["absent"].state == "failed"


def test_lower_bounds_computed_by_hand(gpu_modules):
    import gpu_floor

    frame = gpu_floor.Frame(1000, 600, 5000, 100_000, 320, 160)
    works = gpu_floor.works(frame)
    pixels, tiles = 320 * 160, 20 * 10
    assert (frame.pixels, frame.tiles) == (pixels, tiles)
    assert works["project_cull"].bytes == 1000 * (11 * 4 + 4)
    assert works["project_fwd"].bytes == 1000 * (4 + 64) + 600 * 59 * 4
    assert works["splats_prepare"].bytes == 1000 * 36
    # 4 passes of 8 bytes read and written, 4 for the histogram; the first pass reads no values.
    assert works["splats_sort"].bytes == 1000 * 64
    # Tiles in 8 bits: one pass over keys of 2 bytes and values of 4.
    fill = 1000 * 20 + 600 * 32 + 5000 * 6
    assert works["tiles_fill"].bytes == fill + 5000 * (2 + 12) + 5000 * 2 + 200 * 4
    assert works["rasterize_fwd"].bytes == 5000 * 5 + 200 * 8 + 600 * 64 + pixels * 16
    assert works["rasterize_fwd"].operations == 100_000 * 19
    assert works["rasterize_bwd"].bytes == 5000 * 5 + 200 * 8 + 600 * 128 + pixels * 28
    assert works["rasterize_bwd"].operations == 100_000 * 34
    assert works["photometric_u8"] == gpu_floor.Work(pixels * 27, pixels * 3 * 154)
    assert works["adam_step"].bytes == 1000 * (59 * 4 * 6 + 4) + 600 * 64
    assert "splats_reduce" not in works
    # From bytes: 1.42 MB at 1 TB/s; from operations if these take longer.
    adam = works["adam_step"]
    assert adam.seconds(1e12, 1e12) == pytest.approx(adam.bytes * 1e-12)
    assert works["rasterize_fwd"].seconds(1e12, 1e11) == pytest.approx(100_000 * 19e-11)
    assert works["rasterize_fwd"].seconds(1e12, None) == pytest.approx(
        works["rasterize_fwd"].bytes * 1e-12
    )

    in_order = gpu_floor.works(gpu_floor.Frame(1000, 600, 5000, 100_000, 320, 160, in_order=True))
    names = list(in_order)
    assert names.index("splats_reduce") == names.index("rasterize_bwd") + 1
    assert in_order["splats_reduce"].bytes == 5000 * 64 + 1000 * 72 + 600 * 32
    more = in_order["rasterize_bwd"].bytes - works["rasterize_bwd"].bytes
    assert more == 5000 * 68 - 600 * 64
    # 1920×1080 are 8160 tiles, 13 bits: two passes. 2²⁰ tiles: keys of 4 bytes, three passes.
    full = gpu_floor.works(gpu_floor.Frame(0, 0, 1, 0, 1920, 1080))["tiles_fill"].bytes
    assert full == 6 + 2 + 2 * 12 + 2 + 8160 * 4
    wide = gpu_floor.works(gpu_floor.Frame(0, 0, 1, 0, 1 << 24, 1))["tiles_fill"].bytes
    assert wide == 8 + 4 + 3 * 16 + 4 + 4 * (1 << 20)


@pytest.mark.emulated
def test_the_sanitizer_program_runs_every_op_and_kernel(gpu_modules, monkeypatch):
    """All stages of a step have a lower bound and a name."""
    import gpu_floor
    import gpu_ops
    import gpu_step
    import gpu_table

    from .ops import emulation

    launched = set()

    def execute(kernel, name, blocks, params):
        launched.add(name)
        emulation.execute(kernel, name, blocks, params)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    monkeypatch.setitem(LAUNCHERS, "cpu", lambda *args: launch_by(execute, *args))
    gpu_ops.every_op(torch.device("cpu"), gpu_ops.SMALL, wide=False, say=lambda line: None)
    # This scene has more tiles than the emulation can process in a short time.
    assert set(KERNELS) - {name.removesuffix("_f64") for name in launched} == {"tiles_start_u32"}

    step = gpu_step.Step(gpu_ops.random_scene(60, 40, 30), torch.device("cpu"), capacity=7)
    photo, gaussians = step.photo.planes.clone(), step.trainer.gaussians.clone()
    losses = [step.run(), step.run()]
    assert losses[0] == losses[1] > 0  # the workload does not change
    assert step.trainer.runner.capacity.instances > 7
    assert torch.equal(photo, step.photo.planes)
    for name, parameter in gaussians.parameters().items():
        torch.testing.assert_close(parameter, step.trainer.gaussians.parameters()[name])
    counts = step.counts()
    assert 0 < counts["seen"] < counts["gaussians"] == 60
    assert 0 < counts["instances"] <= counts["seen"] * 6
    assert 0 < counts["pairs"] <= counts["instances"] * 256
    for in_order in (False, True):
        clock = gpu_step.KernelClock(emulation.execute, time.perf_counter)
        with gpu_step.sums_in_order(in_order), clock.on("cpu"):
            step.queue()
        times = gpu_step.kernel_times(clock.laps, lambda a, b: 1e3 * (b - a))
        assert gpu_step.medians([times, times, times]) == times
        works = gpu_floor.works(gpu_floor.Frame(**counts, in_order=in_order))
        assert list(times) == list(works)
        assert times.keys() <= gpu_table.NAMES.keys()
        assert times["rasterize_fwd"].keys() == {"rasterize_fwd"}
        assert min(t for kernels in times.values() for t in kernels.values()) > 0
    assert not torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(before)


def test_tests_continue_in_a_new_process_after_a_lost_gpu(gpu_modules, tmp_path):
    """The GPU is lost after a test; each new process can use it again."""
    test = tmp_path / "test_them.py"
    test.write_text(
        "import pytest\n"
        "pytestmark = pytest.mark.gpu\n"
        "def test_a(): pass\n"
        "def test_b():\n"
        "    import sys; sys.modules['__main__'].gpu_is_lost = lambda: True\n"
        "    assert 1 == 2, 'one is not two'\n"
        "def test_c(): pytest.skip('not now')\n"
        "@pytest.fixture\n"
        "def broken(): raise RuntimeError('no\\nluck')\n"
        "def test_d(broken): pass\n"
        "def test_e(): pass\n"
    )
    arguments = ["tests", str(test), "--done", str(tmp_path / "done")]
    outcomes, found, log = run_jobs(tmp_path, part("t", *arguments))
    assert outcomes["t"].state == "done", log
    last = [one for _, one in found if one["kind"] == "tests"][-1]
    assert last == {"kind": "tests", "passed": 2, "failed": 2, "skipped": 1, "total": 5}
    failures = [(f["test"].split("::")[1], f["line"]) for _, f in found if f["kind"] == "failure"]
    assert [name for name, _ in failures] == ["test_b", "test_d"]
    assert "one is not two" in failures[0][1]
    assert "luck" in log

    (tmp_path / "test_broken.py").write_text("import no_such_module\n")
    arguments = ["tests", str(tmp_path / "test_broken.py"), "--done", str(tmp_path / "done2")]
    outcomes, found, log = run_jobs(tmp_path, part("t", *arguments))
    assert outcomes["t"].state == "failed"
    assert any(f["kind"] == "failure" and "no_such_module" in f["line"] for _, f in found), found


def part(name, *arguments, limit=100.0, **environment):
    import gpu_jobs

    paths = os.pathsep.join([str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return gpu_jobs.Job(
        name,
        [sys.executable, str(BENCHMARKS / "gpu_parts.py"), *map(str, arguments)],
        limit,
        environment={"PYTHONPATH": paths, **environment},
    )


def test_parsing_the_sanitizer_output(gpu_modules, monkeypatch, tmp_path):
    import gpu_parts

    log = gpu_parts.SanitizerLog()
    text = """========= COMPUTE-SANITIZER
ops: 33 Gaussians
========= Invalid __global__ write of size 4 bytes
=========     at rasterize_bwd+0x1230
=========     by thread (1,0,0) in block (0,0,0)
=========     Address 0x7f is out of bounds
=========
========= Error: Race reported between Write access at rasterize_fwd+0x10 and Read access at x
=========
all ops ran
========= ERROR SUMMARY: 30 errors
========= ERROR SUMMARY: 28 errors were not printed. Use --print-limit option to adjust
"""
    for line in text.splitlines(keepends=True):
        log.read(line)
    assert (log.errors, log.finished, log.last) == (30, True, "ops: 33 Gaussians")
    assert log.first[0] == "Invalid __global__ write of size 4 bytes, at rasterize_bwd+0x1230"
    assert log.first[1].startswith("Error: Race reported between Write access at rasterize_fwd")
    for summary in ("ERROR SUMMARY: 0 errors", "RACECHECK SUMMARY: 0 hazards displayed (0 errors)"):
        log = gpu_parts.SanitizerLog()
        for line in ("========= COMPUTE-SANITIZER\n", f"========= {summary}\n"):
            log.read(line)
        assert (log.errors, log.first, log.finished) == (0, [], False)

    # This program replaces the sanitizer. It does not run our program to its end.
    fake = tmp_path / "compute-sanitizer"
    fake.write_text("#!/bin/sh\nprintf '%s\\n' \"$*\" '========= COMPUTE-SANITIZER' 'ops: first'\n")
    fake.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    outcomes, found, text = run_jobs(tmp_path, part("memcheck", "sanitize", "memcheck", PATH=path))
    assert outcomes["memcheck"].state == "failed"
    assert outcomes["memcheck"].reason == "the program ended (0) at: ops: first"
    assert "--tool memcheck" in text
    assert [f["errors"] for _, f in found] == [0]
    assert gpu_parts.find_tool("no such tool") is None


def test_cpu_training_with_few_packages_installed(gpu_modules, tmp_path):
    """The child process may only import packages that a machine with a GPU has."""
    with torch.random.fork_rng():
        write_toy_dataset(tmp_path / "lego400", n_views=9, width=48, height=36, n_points=200)
    blocked = tmp_path / "site"
    blocked.mkdir()
    (blocked / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in {'tyro', 'pycolmap', 'viser', 'av', 'pillow_heif',\n"
        "                                  'zstandard'}:\n"
        "            raise ImportError(f'{name} is missing')\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    paths = os.pathsep.join([str(blocked), str(ROOT / "src")])
    training = part(
        *("train", "train", tmp_path / "none", tmp_path / "lego400"),
        *("--device", "cpu", "--iterations", 30, "--seeds", 0, 3),
        PYTHONPATH=paths,
        SNOWSPLAT_THREADS="1",
    )
    # After the workload, in the same process, the other modules are imported.
    others = "; import gpu_ops, gpu_peer, gpu_step, gpu; print('imported')"
    scenes = f"import gpu_parts; gpu_parts.scenes(['tiny'], pathlib.Path({str(tmp_path)!r}))"
    beside = os.pathsep.join([paths, str(BENCHMARKS)])
    outcomes, found, log = run_jobs(
        tmp_path,
        training,
        job("scenes", "import pathlib; " + scenes + others, environment={"PYTHONPATH": beside}),
    )
    assert {outcome.state for outcome in outcomes.values()} == {"done"}, log
    absent, *runs = [one for name, one in found if name == "train"]
    assert absent == {"kind": "absent", "dataset": "none"}
    assert [(f["dataset"], f["seed"]) for f in runs] == [("lego400", 0), ("lego400", 3)]
    for run in runs:
        assert (run["device"], run["iterations"]) == ("cpu", 30)
        assert 5 < run["psnr"] < 60
        assert run["seconds"] > 0
        assert run["peak"] > 1e8
        assert run["psnr_on_cpu"] is None
    assert (tmp_path / "tiny.scene").exists()


def test_the_page_of_a_gpu(gpu_modules):
    """The page has the figures and derived values; every heading has the name of the card."""
    import gpu_table
    from gpu_jobs import Outcome

    findings = gpu_table.Findings()

    def add(job, kind, **values):
        findings.add(job, {"kind": kind, **values})

    add("probe", "gpu", name="Card X")
    empty = gpu_table.page(findings, [], "2030-01-01", running=True)
    assert empty.startswith("# Card X, 2030-01-01 (not finished)\n")
    card = {"name": "Card X", "capability": "9.0", "multiprocessors": 100, "memory_gb": 80.0}
    software = {"torch": "2.9", "python": "3.12", "kernels": "built for sm_90"}
    card |= {"l2_mb": 50.0, "cores": 16, "clocks": "as they are"}
    add("device", "device", **card, **software)
    add("device", "bandwidth", bytes_a_second=2e12)
    add("device", "rate", operations_a_second=1e13, clocks="high")
    for passed in range(90):
        add("a", "tests", passed=passed, failed=1, skipped=2, total=93)
    for i in range(30):
        add("a", "failure", test=f"tests/a.py::t{i}", line="went wrong " + 300 * "x")
    add("memcheck", "sanitizer", tool="memcheck", errors=2, counted=True, lines=["Invalid write"],
        last="ops: 33", finished=False)  # fmt: skip
    key = {"dataset": "fox", "iterations": 3000, "seed": 0, "ssim": 0.9, "gaussians": 65_000}
    add("c", "training", device="cpu", psnr=32.0, seconds=30.0, peak=9e8, psnr_on_cpu=None, **key)
    add(
        "g", "training", device="cuda", psnr=32.25, seconds=6.0, peak=2e8, psnr_on_cpu=32.251, **key
    )
    add("g", "absent", dataset="lego400")
    for size, count, peak in (("3m", 3_000_000, 2.5e9), ("1m", 1_000_000, 1e9)):
        counts = {"gaussians": count, "seen": count // 2, "instances": 4 * count}
        add(size, "frame", size=size, pairs=10**8, width=1920, height=1080, **counts)
        add(size, "scene", size=size, source="a garden")
        add(size, "memory", size=size, peak=peak, allocated=peak / 2)
        for in_order in (False, True):
            kernels = {"adam_step": {"adam_update": 2.0, "adam_splat_of": 0.832}, "new": {"k": 1.0}}
            if in_order:
                kernels["splats_reduce"] = {"splats_reduce": 0.5}
            add(size, "stages", size=size, in_order=in_order, kernels=kernels)
            gpu = 5.0 + in_order
            add(size, "step", size=size, in_order=in_order, gpu=gpu, host=2.0, wall=5.5, peak=peak)
    add("peer", "peer", version="1.5")
    add("p", "peer image", size="1m", psnr=48.0)
    add("p", "peer times", size="1m", what="training step", ours=5.0, theirs=15.0, packed=False)
    outcomes = [Outcome("a", "done", 10.0), Outcome("b", "late", 60.0, "ended after 60 s")]
    text = gpu_table.page(findings, outcomes, "2030-01-01", running=False)

    assert len(text) < 11_500
    headings = [line for line in text.splitlines() if line.startswith("#")]
    assert all("Card X" in line for line in headings if line != "## What was run")
    assert "89 passed, 1 failed, 2 skipped, 1 not reached, of 93 in 1 files" in text
    assert "- and 18 more" in text
    assert "memcheck: 2 errors; not finished, at: ops: 33" in text
    assert (
        "| fox | 3000 | 0 | 32.00 | 32.25 | +0.25 | 30.0 | 6.0 | 500 | 65,000 | 200 | +0.001 |"
        in text
    )
    assert "fox: mean difference +0.250 dB, NOT within 0.1 dB" in text
    assert "Missing, so not trained: lego400" in text
    # 1m: 1000000 × (59 × 24 + 4) + 500000 × 64 bytes at 2 TB/s take 0.726 of the 2.832 ms.
    assert "| Adam | 2.832 | 0.726 | 26% |" in text
    assert "| new | 1.000 |  |  |" in text
    assert "| rest (PyTorch) | 1.168 |" in text
    assert "| 1m | 5.000 | 2.000 | 5.500 | GPU | 182 | 1.20 | 1000 | 500 | 1000 |" in text
    assert "1m to 3m: 750 bytes more per Gaussian, within the goal" in text
    assert "| 1m | training step | 5.000 | 15.000 | 3.00 | goal 2: reached |" in text
    assert "Done: a 10 s." in text
    assert "- b: late after 60 s; ended after 60 s" in text
    assert findings.wrong() == 32
    kinds = [f["kind"] for f in findings.as_json()]
    assert kinds.count("tests") == 1


def test_the_jobs_of_a_run(gpu_modules, tmp_path):
    """All parts are included, timed jobs run alone, and `gpu_parts.py` accepts all flags."""
    import gpu
    import gpu_parts

    (tmp_path / "garden_points.npz").touch()
    flags = argparse.Namespace(
        datasets=tmp_path, only=list(gpu.GROUPS), seeds=[0, 1], peer=None, arch="9.0"
    )
    planned = gpu.jobs(flags, tmp_path)
    names = [job.name for job in planned]
    assert len(set(names)) == len(names)
    assert names[0] == "device"
    assert {"stages 200k", "stages 1m", "stages 3m", "memcheck", "racecheck"} <= set(names)
    assert "tests/ops/test_rasterize.py" in names
    assert "tests/training/test_trainer_gpu.py" in names
    first_alone = next(i for i, job in enumerate(planned) if job.alone and i > 0)
    assert all(job.alone for job in planned[first_alone:])
    for job in planned:
        assert job.environment["SNOWSPLAT_GARDEN"] == str(tmp_path / "garden_points.npz")
        gpu_parts.parse(list(job.command[2:]))
    flags.only = ["stages"]
    names = [job.name for job in gpu.jobs(flags, tmp_path)]
    assert names == ["make scenes", "stages 1m", "stages 200k", "stages 3m"]


class FakeEvent:
    """A GPU event that records the time of the CPU."""

    def __init__(self, enable_timing=False):
        self.time = 0.0

    def record(self):
        self.time = time.perf_counter()

    def elapsed_time(self, other):
        return 1e3 * (other.time - self.time)

    def query(self):
        return False

    def synchronize(self):
        pass


@pytest.fixture
def fake_gpu(gpu_modules, monkeypatch):
    """The emulation replaces the GPU. The tests check that the parts run, not their speed."""
    import gpu_peer
    import gpu_step

    from snowsplat.ops.cuda import driver

    from .ops import emulation

    def one_megabyte(*args):
        return 1 << 20

    monkeypatch.setattr(torch.cuda, "Event", FakeEvent)
    for name in ("_sleep", "empty_cache"):
        monkeypatch.setattr(torch.cuda, name, one_megabyte)
    begun = []

    def reset():
        assert begun  # required by PyTorch

    monkeypatch.setattr(torch.cuda, "synchronize", lambda: begun.append(True))
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", reset)
    for name in ("memory_allocated", "max_memory_allocated"):
        monkeypatch.setattr(torch.cuda, name, one_megabyte)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (1 << 20, 1 << 20))
    card = argparse.Namespace(name="Card X", major=9, minor=0, multi_processor_count=2)
    card.total_memory, card.L2_cache_size = 10**9, 10**6
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: card)
    monkeypatch.setattr(driver, "run", emulation.execute)
    for module in (gpu_step, gpu_peer):
        monkeypatch.setattr(module, "GPU", torch.device("cpu"))
    monkeypatch.setitem(LAUNCHERS, "cpu", lambda *args: launch_by(emulation.execute, *args))
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def found_in(text):
    import gpu_jobs

    lines = [line.partition(gpu_jobs.MARK) for line in text.splitlines()]
    return [json.loads(rest) for _, marked, rest in lines if marked]


def page_of(found):
    import gpu_table

    findings = gpu_table.Findings()
    for one in found:
        findings.add("job", one)
    return gpu_table.page(findings, [], "2030-01-01", running=False)


@pytest.mark.emulated
def test_the_measuring_parts_run(fake_gpu, capsys, tmp_path):
    """All parts run, and the page shows their output."""
    import gpu_ops
    import gpu_parts

    torch.save(gpu_ops.random_scene(60, 40, 30), tmp_path / "1m.scene")
    gpu_parts.device()
    gpu_parts.stages("1m", tmp_path, repeats=2)
    text = capsys.readouterr().out
    found = found_in(text)
    kinds = [one["kind"] for one in found]
    assert kinds[:2] == ["device", "bandwidth"]
    assert "rate" not in kinds  # needs a driver
    assert "multiply-adds were not measured" in text
    assert kinds[-6:] == ["frame", "memory", "step", "stages", "step", "stages"]
    stages = [one for one in found if one["kind"] == "stages"]
    assert [one["in_order"] for one in stages] == [False, True]
    assert "splats_reduce" in stages[1]["kernels"].keys() - stages[0]["kernels"].keys()
    for step in (one for one in found if one["kind"] == "step"):
        assert min(step["gpu"], step["host"], step["wall"]) > 0
    page = page_of(found)
    frame = next(one for one in found if one["kind"] == "frame")
    assert f"60 Gaussians of random Gaussians, 40×30, {frame['seen']} visible" in page
    for name in ("project: cull", "blend backward", "Adam", "whole step"):
        assert f"| {name} | " in page
    assert "| reduce | " in page


@pytest.mark.emulated
def test_comparison_with_a_peer(fake_gpu, capsys, monkeypatch):
    """The peer is our reference implementation, so the images are equal."""
    import gpu_ops
    import gpu_peer

    gpu_peer.build()
    (none,) = found_in(capsys.readouterr().out)
    assert none["kind"] == "no peer"
    assert "Not measured" in page_of([none])

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane,
        sh_degree, packed,
    ):  # fmt: skip
        assert viewmats.shape == (1, 4, 4)
        gaussians = Gaussians(
            means, scales.log(), quats, opacities.logit(), colors[:, :1], colors[:, 1:]
        )
        (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
        view = ops.View(viewmats[0, :3], width, height, fx, fy, cx, cy, sh_degree, near_plane)
        splats = reference.project(gaussians, view)
        image, alpha, _ = reference.rasterize(splats, width, height)
        return image[None], alpha[None, :, :, None], {}

    peer = argparse.Namespace(rasterization=rasterization, __version__="9.9")
    monkeypatch.setitem(sys.modules, "gsplat", peer)
    gpu_peer.build()
    gpu_peer.compare(gpu_ops.random_scene(60, 40, 30), "1m", repeats=1)
    found = found_in(capsys.readouterr().out)
    assert found[0] == {"kind": "peer", "version": "9.9"}
    assert found[1]["kind"] == "peer image"
    assert found[1]["psnr"] > 90
    whats = [one["what"] for one in found[2:]]
    assert whats == ["image", "image and gradient", "training step"]
    assert all(min(one["ours"], one["theirs"]) > 0 for one in found[2:])
    page = page_of(found)
    assert "compared with gsplat 9.9" in page
    assert "| 1m | training step | " in page


FAKE_RUN = """
import sys
sys.path.insert(0, BENCHMARKS)
import gpu, gpu_jobs
report = "print('@@ {}', flush=True); "
def job(name, code, **more):
    return gpu_jobs.Job(name, [sys.executable, "-c", code], 30.0, **more)
gpu.probe = lambda: {"kind": "gpu", "name": "Card X"}
failure = report.format('{"kind": "failure", "test": "t", "line": "no"}')
tests = report.format('{"kind": "tests", "passed": 1, "failed": 1, "skipped": 0, "total": 2}')
gpu.jobs = lambda flags, scratch: [
    job("tests", failure + tests),
    job("train", "import os; os.abort()"),
    job("slow", "import time; time.sleep(LONG)", alone=True),
]
sys.exit(gpu.main())
"""


@pytest.mark.parametrize("long", [0, LONG], ids=["to its end", "killed"])
def test_a_complete_run_writes_its_page(tmp_path, long):
    code = FAKE_RUN.replace("BENCHMARKS", repr(str(BENCHMARKS))).replace("LONG", str(long))
    run = fork_server.popen("-c", code, "--out", tmp_path)
    if long:
        page, until = tmp_path / "gpu.md", time.monotonic() + 60

        def both_have_ended():
            text = page.read_text() if page.exists() else ""
            return "- train: failed" in text and "Done: tests" in text

        while not both_have_ended():
            assert time.monotonic() < until
            time.sleep(0.05)
        assert "(not finished)" in page.read_text()
        run.terminate()
    text, _ = run.communicate(timeout=60)
    assert run.returncode == (143 if long else 1)
    page = (tmp_path / "gpu.md").read_text()
    assert text.endswith(page + "\n")
    assert page.startswith("# Card X, ")
    assert "(not finished)" not in page
    assert "1 passed, 1 failed, 0 skipped, of 2 in 1 files" in page
    assert "- train: failed" in page
    assert ("- slow: " in page) == bool(long)
    kinds = [one["kind"] for one in json.loads((tmp_path / "gpu.json").read_text())]
    assert kinds == ["gpu", "failure", "tests"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gpu.json", "gpu.log", "gpu.md"]
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout
    assert f"time.sleep({LONG})" not in running


def test_levels_of_detail(tmp_path):
    out = tmp_path / "out"
    dataset = write_toy_dataset(tmp_path / "toy", "colmap-bin", 6, 64, 48, n_points=400)
    assert main(["train", str(dataset), "-o", str(out), "--iterations", "20", "--quiet"]) == 0
    text = benchmark("lod.py", out, "--count", 3000, "--folder", tmp_path / "large", "--no-browser")
    levels = re.findall(r"^ +(\d)  +([\d,]+)   ( *inf| *[\d.]+)", text, re.MULTILINE)
    assert [level for level, *_ in levels] == ["0", "1", "2", "3"]
    assert re.search(r"convert: \d+ s, \d+ s of processor time, at most \d\.\d\d GB", text)
    assert read_index(tmp_path / "large/levels/lod-meta.json").counts() == [3000]
