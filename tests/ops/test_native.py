import functools
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

import snowsplat
from snowsplat.ops import native
from snowsplat.util import native_layout as layout
from snowsplat.util import native_library
from snowsplat.util.errors import UserError

from .. import fork_server


@pytest.fixture
def fresh(monkeypatch):
    """Resets the loader to the state before the first launch, also after the test."""
    monkeypatch.delenv("SNOWSPLAT_ISA", raising=False)
    monkeypatch.delenv("SNOWSPLAT_THREADS", raising=False)
    for name in ("available_isas", "library"):
        plain = getattr(native_library, name).__wrapped__
        monkeypatch.setattr(native_library, name, functools.cache(plain))
    monkeypatch.setattr(native_library, "_functions", {})


@pytest.fixture(scope="module")
def recorder(tmp_path_factory):
    """A library that records its parameters."""
    folder = tmp_path_factory.mktemp("lib")
    source = Path(__file__).with_name("launch_abi.cpp")
    compiler = os.environ.get("CXX", "c++")
    library = folder / "libsnowsplat_recorder.so"
    include = f"-I{Path(snowsplat.__file__).parent / 'native'}"
    command = [compiler, "-std=c++17", "-shared", "-fPIC", "-O1", include, source, "-o", library]
    subprocess.run(command, check=True)
    return library


@pytest.fixture
def recording(fresh, recorder, monkeypatch):
    monkeypatch.setattr(native_library, "_LIBRARIES", recorder.parent)
    monkeypatch.setattr(native_library, "_choose", lambda: "recorder")


def record(name: str = "record", **changes) -> int:
    fields = {
        "n": 6,
        "out": torch.zeros(6, dtype=torch.float64),
        "nothing": None,
        "first": {"a": 0.1, "b": -(2**40)},
        "second": {"a": -1e300, "b": 2**62},
        "whole": True,
        "last": torch.tensor([7], dtype=torch.int32),
    }
    return native.launch(name, **fields | changes)


@pytest.mark.parametrize("name", ["record", "record_swapped"])
def test_parameters_arrive_by_name_and_at_full_width(recording, name):
    """Wherever they are in the struct."""
    out = torch.zeros(6, dtype=torch.float64)
    assert record(name, out=out) == 2**40 + 6
    assert out.tolist() == [0.1, -(2.0**40), -1e300, 2.0**62, 1.0, 7.0]


def test_torch_parameters_and_n_zero(recording):
    out = torch.nn.Parameter(torch.zeros(6, dtype=torch.float64))
    assert record(out=out, n=0) == 2**40
    assert out.abs().max() == 0


def test_a_struct_of_40_fields(recording):
    """The limit of `SNOW_FIELDS`; the largest struct of the operations has half of them."""
    fields = {"n": 0} | {f"f{i}": i for i in range(1, 40)}
    assert native.launch("record_many", **fields) == 20 + 39


def test_tensors_must_be_contiguous_on_one_device_with_kernels(recording):
    x = torch.zeros(4, 4)
    with pytest.raises(ValueError, match="record: out of shape .4, 4. is not contiguous"):
        record(out=x.t())
    with pytest.raises(UserError, match="no kernels for device meta; use device cpu"):
        record(out=x.to("meta"), last=x.to("meta"))
    with pytest.raises(ValueError, match="record: last is on meta, other tensors are on cpu"):
        record(last=x.to("meta"))


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"out": "text"}, "record: out must be a tensor or None, got str"),
        ({"nothing": 3}, "record: nothing must be a tensor or None, got int"),
        ({"whole": 1.5}, "record: whole must be an int, got float"),
        ({"first": {"a": None, "b": 1}}, "record: first.a must be a float, got NoneType"),
        ({"whole": 2**64}, "record: an integer has more than 64 bits"),
    ],
)
def test_fields_have_their_kinds(recording, changes, found):
    with pytest.raises(TypeError, match=f"^{found}$"):
        record(**changes)


OUTDATED = (
    r"^the native library for recorder does not match the Python files \(record\); rebuild it"
)


@pytest.mark.parametrize(
    "changes", [{"more": 1}, {"first": {"a": 1.0}}, {"second": {"a": 1.0, "b": 1, "c": 1}}]
)
def test_other_fields_than_those_of_the_struct_are_a_one_line_error(recording, changes):
    with pytest.raises(UserError, match=f"{OUTDATED}: .*make native"):
        record(**changes)


def test_another_constant_is_detected(recording, monkeypatch):
    monkeypatch.setattr(layout, "_CONSTANTS", layout._CONSTANTS.replace("tile=16", "tile=32"))
    with pytest.raises(UserError, match=OUTDATED):
        record()


def test_arrays_must_be_contiguous():
    with pytest.raises(ValueError, match=r"an array of shape \(4, 3\) is not contiguous"):
        native_library.call_with_arrays("resample", nodes=np.zeros((3, 4)).T)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_cuda_without_a_gpu_is_an_error_with_the_reason():
    class OnGpu(torch.Tensor):
        device = torch.device("cuda", 0)

    x = torch.empty(3).as_subclass(OnGpu)
    with pytest.raises(ValueError, match="image is on cpu, other tensors are on cuda:0; move"):
        native.launch("rasterize_fwd", n=1, background=x, image=torch.empty(3))
    with pytest.raises(UserError, match="^cuda:0: (there is no NVIDIA|this PyTorch|PyTorch|the )"):
        native.launch("rasterize_fwd", n=1, background=x, image=x)


@pytest.mark.isa
def test_unknown_function_names_the_remedy(fresh):
    with pytest.raises(
        UserError, match=r"does not match the Python files .nonsense.; .*make native"
    ):
        native.query_size("nonsense", torch.device("cpu"))


def test_missing_library_names_the_remedy(fresh, tmp_path, monkeypatch):
    monkeypatch.setattr(native_library, "_LIBRARIES", tmp_path)
    with pytest.raises(UserError, match="libsnowsplat_baseline.so is missing; .*make native"):
        native.isa()


def test_broken_library_is_named(fresh, tmp_path, monkeypatch):
    (tmp_path / "libsnowsplat_baseline.so").write_bytes(b"\x7fELF, but not for long")
    monkeypatch.setattr(native_library, "_LIBRARIES", tmp_path)
    with pytest.raises(UserError, match="libsnowsplat_baseline.so cannot be loaded"):
        native.isa()


def test_the_best_isa_is_selected_and_every_available_one_can_be_forced(fresh, monkeypatch):
    best = native.available_isas()[-1]
    assert native.isa() == best
    for name in native.available_isas():
        monkeypatch.setenv("SNOWSPLAT_ISA", name)
        native_library.library.cache_clear()
        assert native.isa() == name
        library = native_library.library()[1]
        assert native.ISAS[library.built_isa()] == name


def test_unknown_isa_names_the_valid_ones(fresh, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ISA", "sse9")
    with pytest.raises(
        UserError, match="'sse9' is not an instruction set; .* baseline, avx2, avx512"
    ):
        native.isa()


def test_an_unsupported_isa_names_the_supported_ones(fresh, monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_ISA", "avx512")
    monkeypatch.setattr(native_library, "available_isas", lambda: ("baseline",))
    with pytest.raises(UserError, match="avx512 is not supported here; .* have baseline"):
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
        assert native_library.default_threads() == 1
    finally:
        os.sched_setaffinity(0, affinity)
    assert native_library.default_threads() == len(affinity)
    for wrong in ("0", "-2", "many"):
        monkeypatch.setenv("SNOWSPLAT_THREADS", wrong)
        with pytest.raises(UserError, match=f"'{wrong}' is not a number of threads"):
            native_library.default_threads()


@pytest.mark.slow
def test_importing_loads_no_library_and_the_environment_reaches_it():
    # In a fork of a process that has only imported all modules.
    code = (
        "import os, snowsplat; from snowsplat.ops import native;"
        "from snowsplat.util.native_library import library;"
        "print(library.cache_info().currsize);"
        "os.environ['SNOWSPLAT_ISA'] = 'baseline'; print(native.isa(), native.get_num_threads())"
    )
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SNOWSPLAT_")}
    environment = {**clean, "SNOWSPLAT_THREADS": "5", "SNOWSPLAT_ISA": "nonsense"}
    result = fork_server.run("-c", code, env=environment)
    assert result.stdout == "0\nbaseline 5\n", result.stderr
