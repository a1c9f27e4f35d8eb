"""The emulation of CUDA blocks: it detects faults, and its results are correct."""

import os

import pytest
import torch

from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util.native_layout import Mismatch

from . import emulation

LANES = torch.arange(32, dtype=torch.int32)

pytestmark = pytest.mark.emulated


@pytest.fixture(autouse=True)
def _forward(monkeypatch):
    monkeypatch.delenv("SNOWSPLAT_ORDER", raising=False)


def run(
    name: str,
    threads: int,
    n: int,
    *tensors: torch.Tensor,
    total: torch.Tensor | None = None,
    blocks: int = 1,
) -> None:
    """``tensors``: the output, or the input and the output of the kernel."""
    *given, out = tensors
    fields = {"n": n, "given": given[0] if given else None, "out": out, "total": total}
    emulation.execute(Kernel("faults", threads, threads), name, blocks, fields)


def zeros(count: int) -> torch.Tensor:
    return torch.zeros(count, dtype=torch.int32)


@pytest.mark.parametrize("order", ["forward", "backward", "5"])
@pytest.mark.parametrize(
    ("name", "threads", "n", "message"),
    [
        ("two_barriers", 64, 40, r"divergent barrier: thread 0 waits at __syncthreads \(faults.cu"),
        ("barrier_or_vote", 64, 40, "thread 0 waits at __syncthreads .*, thread 40 at a warp's"),
        ("absent_lane", 64, 5, "thread 0 waits at a warp's .* for lanes that do not come"),
        ("absent_lane", 64, 0, "thread 1 waits at a warp's .* for lanes that do not come"),
        ("short_warp", 48, 48, "thread 32 waits at a warp's .* for lanes that do not come"),
        ("two_masks", 32, 16, "for lanes that do not come"),
        ("not_in_its_mask", 32, 3, r"lane 3 is not in the mask that it gives \(faults.cu:"),
    ],
)
def test_deadlocks_are_reported(name, threads, n, message, order, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ORDER", order)
    with pytest.raises(RuntimeError, match=f"{name}: block 0: .*{message}"):
        run(name, threads, n, zeros(threads))
    out = zeros(64)
    run("double_all", 64, 64, out + 3)  # the next kernel is not affected


def test_all_threads_at_one_barrier_are_fine():
    for name, n in (("two_barriers", 64), ("two_barriers", 0), ("barrier_or_vote", 64)):
        out = zeros(64)
        run(name, 64, n, out)
        assert out.tolist() == [1] * 64
    run("short_warp", 48, 32, zeros(48))
    # A barrier of one warp, while the threads of the other wait for the block.
    with pytest.raises(RuntimeError, match="divergent barrier"):
        run("barrier_or_vote", 64, 32, zeros(64))


@pytest.mark.parametrize("order", ["backward", "1", "2"])
def test_a_missing_barrier_is_visible_in_another_order(order, monkeypatch):
    given, right, out = torch.arange(64, dtype=torch.int32), zeros(64), zeros(64)
    run("missing_barrier", 64, 1, given, right)
    assert right.tolist() == [0, *range(63)]
    monkeypatch.setenv("SNOWSPLAT_ORDER", order)
    run("missing_barrier", 64, 1, given, out)
    assert not torch.equal(out, right)


@pytest.mark.parametrize("order", ["forward", "backward", "7"])
def test_a_missing_warp_barrier_is_visible(order, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ORDER", order)
    out = zeros(32)
    run("missing_warp_barrier", 32, 1, LANES, out)
    assert torch.equal(out, LANES.flip(0))
    run("missing_warp_barrier", 32, 0, LANES, out)
    assert not torch.equal(out, LANES.flip(0))


def test_shared_memory_is_nan_at_the_start_of_every_block():
    out = torch.zeros(32)
    run("never_written", 32, 20, out, blocks=3)
    assert (out[:20] == 1).all()
    assert out[20:].isnan().all()


OUT_OF_BOUNDS = {
    "run('beyond_shared', 32, 1, zeros(32))": "heap-buffer-overflow",
    "run('beyond_the_tensor', 32, 1, zeros(32))": "heap-buffer-overflow",
    "run('shifted_too_far', 32, 40, zeros(32))": "shift exponent 40 is too large",
}


@pytest.mark.skipif(
    os.environ.get("SNOWSPLAT_EMULATION") != "sanitized", reason="runs in `make sanitized`"
)
@pytest.mark.parametrize(("call", "found"), OUT_OF_BOUNDS.items())
def test_the_sanitizers_find_accesses_out_of_bounds(call, found, tmp_path):
    """A sanitizer ends the process, and Python starts slowly under sanitizers: hence a fork."""
    child = os.fork()
    if child == 0:
        log = os.open(tmp_path / "log", os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 2)
        try:
            eval(call)
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
    assert found in (tmp_path / "log").read_text(errors="replace")


def test_threads_and_parameters_are_checked():
    with pytest.raises(Mismatch, match="double_all: no value for 'given'"):
        emulation.execute(Kernel("faults", 64, 64), "double_all", 1, {"n": 1})
    with pytest.raises(AssertionError, match="double_all has 64 threads, its Kernel says 32"):
        run("double_all", 32, 1, zeros(1))
