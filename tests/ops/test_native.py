import functools
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import snowsplat
from snowsplat.ops import native
from snowsplat.util.errors import UserError

SOURCES = Path(snowsplat.__file__).parents[1]


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SNOWSPLAT_")}
    clean |= {"PYTHONPATH": str(SOURCES)} | environment
    return subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True)


@pytest.fixture
def fresh(monkeypatch):
    """The loader as it is before the first launch, and again after the test."""
    monkeypatch.delenv("SNOWSPLAT_ISA", raising=False)
    monkeypatch.delenv("SNOWSPLAT_THREADS", raising=False)
    for name in ("available_isas", "_library"):
        monkeypatch.setattr(native, name, functools.cache(getattr(native, name).__wrapped__))
    monkeypatch.setattr(native, "_functions", {})


@pytest.fixture(scope="module")
def recorder(tmp_path_factory):
    """A library that writes down how its arguments arrived."""
    folder = tmp_path_factory.mktemp("lib")
    source = Path(__file__).with_name("launch_abi.cpp")
    compiler = os.environ.get("CXX", "c++")
    library = folder / "libsnowsplat_recorder.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", str(source), "-o", library], check=True)
    return library


@pytest.fixture
def recording(fresh, recorder, monkeypatch):
    monkeypatch.setattr(native, "_LIBRARIES", recorder.parent)
    monkeypatch.setattr(native, "_choose", lambda: "recorder")


SCALARS = [x for i in range(10) for x in (-(2**40) - i, i + 0.1)]


def test_arguments_arrive_in_order_and_at_full_width(recording):
    out = torch.zeros(21, dtype=torch.float64)
    last = torch.tensor([7], dtype=torch.int32)
    result = native.launch("record", 21, out, None, *SCALARS, last)
    assert result == 2**40 + 21
    assert out.tolist() == [*SCALARS, 7.0]


def test_bools_parameters_and_n_zero(recording):
    out = torch.nn.Parameter(torch.zeros(21, dtype=torch.float64))
    last = torch.zeros(1, dtype=torch.int32)
    assert native.launch("record", 0, out, None, *SCALARS, last) == 2**40
    assert out.abs().max() == 0
    native.launch("record", 2, out, None, True, *SCALARS[1:], last)
    assert out[:2].tolist() == [1.0, 0.1]


def test_launch_costs_little(recording):
    out = torch.zeros(21, dtype=torch.float64)
    last = torch.zeros(1, dtype=torch.int32)

    def batch() -> float:
        start = time.thread_time()
        for _ in range(200):
            native.launch("record", 0, out, None, *SCALARS, last)
        return (time.thread_time() - start) / 200

    assert min(batch() for _ in range(10)) < 30e-6  # 8 µs on an idle machine


def test_tensors_must_be_contiguous_on_one_device_and_on_the_cpu(recording):
    x = torch.zeros(4, 4)
    with pytest.raises(ValueError, match="record: argument 2 of shape .4, 4. is not contiguous"):
        native.launch("record", 1, x, x.t())
    with pytest.raises(UserError, match="no kernels for device meta; use device cpu"):
        native.launch("record", 1, x.to("meta"))
    with pytest.raises(ValueError, match="tensors on cpu and on meta"):
        native.launch("record", 1, x, x.to("meta"))
    with pytest.raises(TypeError, match="argument 2 is a str"):
        native.launch("record", 1, x, "x")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_cuda_without_a_gpu_says_why():
    # Fake tensors carry the device and no memory.
    from torch._subclasses.fake_tensor import FakeTensorMode

    class OnGpu(torch.Tensor):
        device = torch.device("cuda", 0)

    with FakeTensorMode():
        x = torch.empty(3, device="cuda")
        with pytest.raises(ValueError, match="tensors on cuda:0 and on cpu; move them to one"):
            native.launch("accumulate_screen_statistics", 1, x, torch.empty(3))
    x = torch.empty(3).as_subclass(OnGpu)
    with pytest.raises(UserError, match="^cuda:0: (there is no NVIDIA|this PyTorch|PyTorch|the )"):
        native.launch("accumulate_screen_statistics", 1, x)


@pytest.mark.isa
def test_unknown_function_names_the_remedy(fresh):
    with pytest.raises(UserError, match=r"no function nonsense.*make native"):
        native.launch("nonsense", 1)


def test_missing_library_names_the_remedy(fresh, tmp_path, monkeypatch):
    monkeypatch.setattr(native, "_LIBRARIES", tmp_path)
    with pytest.raises(UserError, match="libsnowsplat_baseline.so is missing; .*make native"):
        native.isa()


def test_broken_library_is_named(fresh, tmp_path, monkeypatch):
    (tmp_path / "libsnowsplat_baseline.so").write_bytes(b"\x7fELF, but not for long")
    monkeypatch.setattr(native, "_LIBRARIES", tmp_path)
    with pytest.raises(UserError, match="libsnowsplat_baseline.so cannot be loaded"):
        native.isa()


def test_best_is_picked_and_every_available_one_can_be_forced(fresh, monkeypatch):
    best = native.available_isas()[-1]
    assert native.isa() == best
    for name in native.available_isas():
        monkeypatch.setenv("SNOWSPLAT_ISA", name)
        native._library.cache_clear()
        assert native.isa() == name
        library = native._library()[1]
        assert native.ISAS[library.built_isa()] == name


def test_unknown_isa_names_the_valid_ones(fresh, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ISA", "sse9")
    with pytest.raises(UserError, match="'sse9' is no instruction set; .* baseline, avx2, avx512"):
        native.isa()


def test_isa_this_machine_lacks_names_the_ones_it_has(fresh, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ISA", "avx512")
    monkeypatch.setattr(native, "available_isas", lambda: ("baseline",))
    with pytest.raises(UserError, match="avx512 does not run here; .* have baseline"):
        native.isa()


def test_isa_found_agrees_with_the_kernel(fresh):
    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists() or "flags" not in cpuinfo.read_text():
        pytest.skip("needs the flags of /proc/cpuinfo")
    flags = next(line for line in cpuinfo.read_text().splitlines() if line.startswith("flags"))
    expected = ["baseline"]
    expected += ["avx2"] if {"avx2", "fma", "bmi2"} <= set(flags.split()) else []
    expected += ["avx512"] if {"avx512f", "avx512bw", "avx512vl"} <= set(flags.split()) else []
    assert list(native.available_isas()) == expected


@pytest.mark.isa
def test_threads_can_be_set():
    before = native.get_num_threads()
    try:
        for threads in (1, 3):
            native.set_num_threads(threads)
            assert native.get_num_threads() == threads
    finally:
        native.set_num_threads(before)
    with pytest.raises(UserError, match="1 or more, not 0"):
        native.set_num_threads(0)


def test_threads_come_from_the_environment_or_the_affinity(monkeypatch):
    affinity = os.sched_getaffinity(0)
    monkeypatch.delenv("SNOWSPLAT_THREADS", raising=False)
    try:
        os.sched_setaffinity(0, {min(affinity)})
        assert native._default_threads() == 1
    finally:
        os.sched_setaffinity(0, affinity)
    assert native._default_threads() == len(affinity)
    for wrong in ("0", "-2", "many"):
        monkeypatch.setenv("SNOWSPLAT_THREADS", wrong)
        with pytest.raises(UserError, match=f"'{wrong}' is no number of threads"):
            native._default_threads()


@pytest.mark.slow
def test_environment_reaches_the_library():
    code = "from snowsplat.ops import native; print(native.isa(), native.get_num_threads())"
    result = run_python(code, SNOWSPLAT_THREADS="5", SNOWSPLAT_ISA="baseline")
    assert result.stdout == "baseline 5\n", result.stderr


@pytest.mark.slow
def test_importing_loads_no_library():
    code = "import snowsplat; from snowsplat.ops import native; print(native._library.cache_info())"
    assert "currsize=0" in run_python(code, SNOWSPLAT_ISA="nonsense").stdout
