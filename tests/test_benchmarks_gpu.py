"""`benchmarks/gpu.py` and its parts run on the CPU, where the emulation replaces the GPU."""

import argparse
import json
import time
from pathlib import Path

import pytest
import torch

from snowsplat.ops.cuda.launches import KERNELS, launch_by
from snowsplat.ops.native import LAUNCHERS

from . import fork_server

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
pytestmark = pytest.mark.slow


@pytest.fixture
def gpu_modules(monkeypatch):
    """The modules beside gpu.py, which can then be imported by name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("SNOWSPLAT_GARDEN", "none")


def test_without_a_gpu_it_prints_one_line(tmp_path):
    environment = fork_server.ENVIRONMENT | {"CUDA_VISIBLE_DEVICES": ""}
    run = fork_server.run(BENCHMARKS / "gpu.py", "--out", tmp_path / "out", env=environment)
    assert run.returncode == 2
    assert run.stdout.startswith("gpu: nothing was measured: ")
    assert len(run.stdout.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_the_jobs_of_a_run(gpu_modules, tmp_path):
    """All parts are included, timed jobs run alone, and `gpu_parts.py` accepts all flags."""
    import gpu
    import gpu_parts

    flags = argparse.Namespace(
        datasets=tmp_path, only=list(gpu.GROUPS), seeds=[0, 1], peer=None, arch="9.0", minutes=8.8
    )
    planned = gpu.jobs(flags, tmp_path)
    names = [job.name for job in planned]
    assert {"device", "stages 1m", "memcheck", "tests/ops/test_rasterize.py"} <= set(names)
    first_alone = next(i for i, job in enumerate(planned) if job.alone and i > 0)
    assert all(job.alone for job in planned[first_alone:])
    for job in planned:
        gpu_parts.parse(list(job.command[2:]))


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
    for name in ("memory_allocated", "max_memory_allocated", "max_memory_reserved"):
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


@pytest.mark.emulated
@pytest.mark.nightly
def test_the_sanitizer_program_runs_every_kernel(fake_gpu, monkeypatch):
    import gpu_ops

    from .ops import emulation

    launched = set()

    def execute(kernel, name, blocks, fields):
        launched.add(name)
        emulation.execute(kernel, name, blocks, fields)

    monkeypatch.setitem(LAUNCHERS, "cpu", lambda *args: launch_by(execute, *args))
    gpu_ops.every_op(torch.device("cpu"), gpu_ops.SMALL, wide=False, say=lambda line: None)
    # This scene has more tiles than the emulation can process in a short time.
    assert set(KERNELS) - {name.removesuffix("_f64") for name in launched} == {"tiles_start_u32"}


@pytest.mark.emulated
@pytest.mark.nightly
def test_the_measuring_parts_run(fake_gpu, capsys, tmp_path):
    """Each stage of a step has a time, a lower bound and a row of the page."""
    import gpu_floor
    import gpu_ops
    import gpu_parts
    import gpu_table

    torch.save(gpu_ops.random_scene(60, 40, 30), tmp_path / "1m.scene")
    gpu_parts.device()
    gpu_parts.stages("1m", tmp_path, repeats=1)
    found = found_in(capsys.readouterr().out)
    kinds = [one["kind"] for one in found]
    assert kinds[:2] == ["device", "bandwidth"]
    assert kinds[-6:] == ["frame", "memory", "step", "stages", "step", "stages"]
    frame = found[kinds.index("frame")]
    assert 0 < frame["seen"] < frame["gaussians"] == 60
    assert 0 < frame["pairs"] <= frame["instances"] * 256
    counts = {
        name: frame[name] for name in ("gaussians", "seen", "instances", "pairs", "width", "height")
    }
    for one in found:
        if one["kind"] == "stages":
            in_order = one["in_order"]
            works = gpu_floor.works(gpu_floor.Frame(**counts, in_order=in_order))
            assert list(one["kernels"]) == list(works)
            assert one["kernels"].keys() <= gpu_table.NAMES.keys()
            assert ("splats_reduce" in one["kernels"]) == in_order
            assert min(t for times in one["kernels"].values() for t in times.values()) > 0
        elif one["kind"] == "step":
            assert min(one["gpu"], one["host"], one["wall"]) > 0
    findings = gpu_table.Findings()
    for one in found:
        findings.add("job", one)
    page = gpu_table.page(findings, [], "2030-01-01", running=False)
    assert f"60 Gaussians of random Gaussians, 40×30, {frame['seen']} visible" in page
    for name in ("project: cull", "blend backward", "Adam", "reduce", "whole step"):
        assert f"| {name} | " in page
