"""Loading and launching on a GPU, with a fake driver that records the calls."""

import ctypes
import importlib.util
import os
import struct
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import snowsplat
from snowsplat.ops import native
from snowsplat.ops.cuda import cubins, driver, nvrtc
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util import native_layout
from snowsplat.util.errors import UserError

LAYOUT = native_layout._CONSTANTS + "|n:i;missing:p;tensor:p;large:i;real:d;"


def some(tensor: torch.Tensor, **changes) -> dict[str, Any]:
    """The fields of the struct of every kernel."""
    return {"n": 1, "missing": None, "tensor": tensor, "large": 0, "real": 0.0} | changes


KERNEL = Kernel("statistic", threads=128, items=64)
BUILT = (70, 75, 80, 86, 89, 90, 100, 120)  # as in CMakeLists.txt


class OnGpu(torch.Tensor):
    """A tensor that reports the device cuda:`index`."""

    index = 0
    __torch_function__ = torch._C._disabled_torch_function_impl

    @property
    def device(self):
        return torch.device("cuda", self.index)


class OnSecondGpu(OnGpu):
    index = 1


def on_gpu(tensor: torch.Tensor, kind: type = OnGpu) -> torch.Tensor:
    return tensor.as_subclass(kind)


class FakeDriver:
    """Replaces cuda.bindings.driver: each function returns an error number and results."""

    def __init__(self):
        self.calls = []
        self.launches = []
        self.fails = {}  # function → error, or code → error
        self.layout = LAYOUT  # of every kernel's struct
        self._contexts = threading.local()

    def _call(self, name, *args):
        self.calls.append((name, *args))
        return self.fails.get(name, 0)

    def count(self, name):
        return sum(call[0] == name for call in self.calls)

    def cuInit(self, flags):
        return (self._call("cuInit"),)

    def cuDriverGetVersion(self):
        return 0, 12090

    def cuDeviceGet(self, index):
        return self._call("cuDeviceGet", index), index

    def cuDevicePrimaryCtxRetain(self, device):
        return self._call("cuDevicePrimaryCtxRetain", device), 1000 + device

    def _stack(self):
        return self._contexts.__dict__.setdefault("stack", [0])

    def cuCtxGetCurrent(self):
        return 0, self._stack()[-1]

    def cuCtxPushCurrent(self, context):
        self._stack().append(context)
        return (self._call("cuCtxPushCurrent", context),)

    def cuCtxPopCurrent(self):
        return self._call("cuCtxPopCurrent"), self._stack().pop()

    def cuLibraryLoadData(self, code, *rest):
        assert rest == (None, None, 0, None, None, 0)
        return self._call("cuLibraryLoadData", code) or self.fails.get(code, 0), code

    def cuLibraryGetKernel(self, library, name):
        return self._call("cuLibraryGetKernel", library, name), (library, name)

    def cuKernelGetFunction(self, kernel):
        return self._call("cuKernelGetFunction", kernel), (*kernel, self._stack()[-1])

    def cuLibraryGetGlobal(self, library, name):
        assert name.endswith(b"_fields")
        # The variable has numbers behind the text.
        return self._call("cuLibraryGetGlobal", library, name), 4096, len(self.layout) + 9

    def cuMemcpyDtoH(self, target, source, size):
        assert (source, size) == (4096, len(self.layout) + 9)
        target[:] = self.layout.encode() + b"\0" + 8 * b"x"
        return (self._call("cuMemcpyDtoH"),)

    def cuLaunchKernel(self, function, *rest):
        gx, gy, gz, bx, by, bz, shared, stream, parameters, extra = rest
        assert (gy, gz, by, bz, shared, extra) == (1, 1, 1, 1, 0, 0)
        struct = ctypes.c_void_p.from_address(parameters).value
        launch = SimpleNamespace(
            function=function,
            blocks=gx,
            threads=bx,
            stream=stream,
            context=self._stack()[-1],
            struct=ctypes.string_at(struct, 40),
        )
        self.launches.append(launch)
        return (self._call("cuLaunchKernel"),)

    def cuGetErrorName(self, error):
        return 0, f"CUDA_ERROR_{error}".encode()

    def cuGetErrorString(self, error):
        return 0, b"in words"


@pytest.fixture
def built(tmp_path, monkeypatch) -> Path:
    """Cubins for each architecture of the wheel; their content is their name."""
    folder = tmp_path / "built"
    for number in BUILT:
        (folder / f"sm_{number}").mkdir(parents=True)
        for file in ("statistic", "rasterize"):
            (folder / f"sm_{number}" / f"{file}.cubin").write_bytes(f"{file} {number}".encode())
    monkeypatch.setattr(cubins, "_BUILT", folder)
    return folder


@pytest.fixture
def gpus(built, monkeypatch) -> FakeDriver:
    """Two GPUs, of compute capability 8.6 and 9.0, each with its own stream."""
    fake = FakeDriver()
    monkeypatch.setattr(driver, "_bindings", lambda: fake)
    monkeypatch.setattr(driver, "_gpus", {})
    monkeypatch.setattr(driver, "why_unusable", lambda index: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda i: ((8, 6), (9, 0))[i])
    stream_of = (70, 71).__getitem__
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", stream_of, raising=False)
    return fake


class FakeCompiler:
    version = (12, 9)
    architectures = (50, 70, 72, 75, 80, 86, 87, 89, 90, 100, 103, 120)

    def __init__(self):
        self.compiled = []

    def compile(self, source, target):
        self.compiled.append((source.stem, target))
        return f"{source.stem} for {target}, {len(self.compiled)}".encode(), ""


@pytest.fixture
def compiler(tmp_path, monkeypatch) -> FakeCompiler:
    """Replaces NVRTC, with a separate cache folder."""
    fake = FakeCompiler()
    monkeypatch.setattr(cubins, "_nvrtc", lambda cuda_major: fake)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return fake


# ---- launching


def test_the_driver_reads_the_struct(gpus):
    tensor = on_gpu(torch.zeros(5))
    driver.run(KERNEL, "some_kernel", 7, some(tensor, n=3, large=-(2**40), real=0.1))
    (launch,) = gpus.launches
    assert (launch.blocks, launch.threads, launch.stream) == (7, 128, 70)
    assert struct.unpack("=qQQqd", launch.struct) == (3, 0, tensor.data_ptr(), -(2**40), 0.1)
    assert launch.function == (b"statistic 86", b"some_kernel", 1000)


@pytest.mark.parametrize(
    ("function", "error"), [(None, 0), ("cuLibraryGetGlobal", 500), ("cuMemcpyDtoH", 1)]
)
def test_a_kernel_with_another_struct_is_rejected(function, error, gpus):
    """It is rejected before the launch. Kernels older than the structs have no layout."""
    if function is None:
        gpus.layout = LAYOUT.replace("large", "larger")
    gpus.fails[function] = error
    line = (
        "some_kernel: the built kernels do not match the Python files: rebuild them .make native."
    )
    if error == 1:
        line = "some_kernel: CUDA_ERROR_1, in words; update the NVIDIA driver"
    for _ in range(2):
        with pytest.raises(UserError, match=f"^cuda:0: {line}"):
            driver.run(KERNEL, "some_kernel", 1, some(on_gpu(torch.zeros(1))))
    assert gpus.launches == []
    assert gpus.cuCtxGetCurrent() == (0, 0)


def test_code_is_loaded_once_for_each_file_and_device(gpus):
    first, second = on_gpu(torch.zeros(1)), on_gpu(torch.zeros(1), OnSecondGpu)
    rasterize = Kernel("rasterize", threads=32, items=32)
    for _ in range(3):
        driver.run(KERNEL, "one", 1, some(first))
        driver.run(KERNEL, "one_f64", 1, some(first))
        driver.run(KERNEL, "one", 1, some(second))
        driver.run(rasterize, "two", 1, some(second))
    loaded = [call[1] for call in gpus.calls if call[0] == "cuLibraryLoadData"]
    assert loaded == [b"statistic 86", b"statistic 90", b"rasterize 90"]
    assert gpus.count("cuLibraryGetKernel") == 4
    assert gpus.count("cuDevicePrimaryCtxRetain") == 2
    assert [(x.context, x.stream) for x in gpus.launches[:4]] == [
        (1000, 70),
        (1000, 70),
        (1001, 71),
        (1001, 71),
    ]


def test_the_context_is_set_and_restored(gpus):
    first, second = on_gpu(torch.zeros(1)), on_gpu(torch.zeros(1), OnSecondGpu)
    driver.run(KERNEL, "one", 1, some(first))
    driver.run(KERNEL, "one", 1, some(second))
    assert gpus.cuCtxGetCurrent() == (0, 0)
    gpus.cuCtxPushCurrent(1000)
    pushes = gpus.count("cuCtxPushCurrent")
    driver.run(KERNEL, "one", 1, some(first))  # already current
    assert gpus.count("cuCtxPushCurrent") == pushes
    driver.run(KERNEL, "one", 1, some(second))
    assert gpus.cuCtxGetCurrent() == (0, 1000)
    assert [launch.context for launch in gpus.launches] == [1000, 1001, 1000, 1001]


def test_threads_have_separate_arguments(gpus):
    tensor = on_gpu(torch.zeros(1))
    driver.run(KERNEL, "one", 1, some(tensor))
    addresses, wrong = set(), []
    barrier = threading.Barrier(4)

    def many(number: int) -> None:
        addresses.add(driver._buffer.address)
        barrier.wait()
        for i in range(200):
            value = number * 1000 + i
            driver.run(KERNEL, "one", value, some(tensor, n=value))

    threads = [threading.Thread(target=many, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wrong = [
        x
        for x in gpus.launches[1:]
        if struct.unpack_from("=q", x.struct) != (x.blocks,) or x.context != 1000
    ]
    assert len(gpus.launches) == 801
    assert not wrong
    assert len(addresses) == 4


@pytest.mark.parametrize(
    ("function", "error", "do"),
    [
        ("cuLaunchKernel", 700, "update the NVIDIA driver, or use device cpu"),
        (
            "cuLibraryLoadData",
            2,
            "close other programs that use the GPU, or make the scene smaller",
        ),
        (
            "cuLibraryGetKernel",
            500,
            "the built kernels do not match the Python files: rebuild them .make native.",
        ),
        ("cuKernelGetFunction", 3, "update the NVIDIA driver, or use device cpu"),
    ],
)
def test_errors_of_the_driver_are_one_line(function, error, do, gpus):
    gpus.fails[function] = error
    line = f"^cuda:1: some_kernel: CUDA_ERROR_{error}, in words; {do}$"
    for _ in range(2):
        with pytest.raises(UserError, match=line):
            driver.run(KERNEL, "some_kernel", 1, some(on_gpu(torch.zeros(1), OnSecondGpu)))
    assert gpus.cuCtxGetCurrent() == (0, 0)
    gpus.fails.clear()
    driver.run(KERNEL, "some_kernel", 1, some(on_gpu(torch.zeros(1), OnSecondGpu)))


def test_a_driver_that_does_not_start_is_a_one_line_error(gpus):
    gpus.fails["cuInit"] = 803
    with pytest.raises(UserError, match="^cuda:0: CUDA_ERROR_803, in words; update"):
        driver.run(KERNEL, "one", 1, some(on_gpu(torch.zeros(1))))


def test_an_unusable_gpu_is_an_error_with_the_reason(gpus, monkeypatch):
    monkeypatch.setattr(driver, "why_unusable", lambda index: "it is too old")
    tensor = on_gpu(torch.zeros(1))
    with pytest.raises(UserError, match="^cuda:0: it is too old$"):
        native.launch("background_bwd", n=1, alpha=tensor)


@pytest.mark.parametrize("error", [200, 209, 218, 222])
@pytest.mark.parametrize("where", ["loading", "finding"])
def test_after_an_incompatible_cubin_the_kernel_is_compiled(error, where, gpus, compiler):
    if where == "loading":
        gpus.fails[b"statistic 86"] = error
    else:
        plain = gpus.cuKernelGetFunction
        gpus.cuKernelGetFunction = lambda k: (error, None) if k[0][-2:] == b"86" else plain(k)
    driver.run(KERNEL, "one", 1, some(on_gpu(torch.zeros(1))))
    assert compiler.compiled == [("statistic", "sm_86")]
    assert gpus.launches[0].function[0] == b"statistic for sm_86, 1"


WITHOUT_A_GPU = """
import torch, sys
before = set(sys.modules)
from snowsplat import ops
from snowsplat.ops.cuda import driver, cubins
ops.neighbours(torch.rand(9, 3), 2)
loaded = [name for name in set(sys.modules) - before if name.startswith("cuda")]
print(driver._bindings.cache_info().currsize, cubins._nvrtc.cache_info().currsize, loaded)
"""
THROUGH_THE_BINDINGS = """
import ctypes, sys, torch
from types import SimpleNamespace
from snowsplat.ops.cuda import cubins, driver
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util import native_layout

stub = ctypes.CDLL("libcuda.so.1")
driver.why_unusable = lambda index: None
torch.cuda.get_device_capability = lambda index: (9, 0)
torch._C._cuda_getCurrentRawStream = lambda index: 0x77
cubins.candidates = lambda file, capability, major: [b"code", file, capability, major][:1]

class OnGpu(torch.Tensor):
    device = torch.device("cuda", 0)

kernel = Kernel("some", threads=96, items=96)
stub_layout = (ctypes.c_char * 1024).in_dll(stub, "layout")
stub_layout.value = (native_layout._CONSTANTS + "|n:i;tensor:p;missing:p;real:d;").encode()
tensor = torch.zeros(3).as_subclass(OnGpu)
fields = {"n": -6, "tensor": tensor, "missing": None, "real": 0.5}
driver.run(kernel, "some_kernel", 5, fields)
values = (ctypes.c_int64 * 4).in_dll(stub, "recorded_values")
sizes = (ctypes.c_int * 6).in_dll(stub, "recorded_size")
pointer = lambda name: ctypes.c_void_p.in_dll(stub, name).value
assert list(sizes) == [5, 1, 1, 96, 1, 1], list(sizes)
assert values[:3] == [-6, tensor.data_ptr(), 0], list(values)
assert ctypes.c_double.from_buffer(values, 24).value == 0.5
assert pointer("recorded_stream") == 0x77 and pointer("recorded_function")
assert pointer("recorded_context") == driver._gpus[0].context != 0
assert (ctypes.c_char * 4).in_dll(stub, "recorded_code").raw == b"code"
assert (ctypes.c_char * 64).in_dll(stub, "recorded_name").value == b"some_kernel"
assert ctypes.c_int.in_dll(stub, "pushed").value == 2  # to load, and to launch
ctypes.c_int.in_dll(stub, "fail_next").value = 700
try:
    driver.run(kernel, "some_kernel", 5, fields)
except driver.UserError as error:
    print(error)
stub_layout.value = stub_layout.value.replace(b"real", b"unreal")
try:
    driver.run(kernel, "other_kernel", 5, fields)
except driver.UserError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def new_process(tmp_path_factory) -> tuple[list[str], str]:
    """Output lines of a new process, which uses the CPU and then a stub of the driver; its errors.

    The stub is used if the bindings are installed.
    """
    code, folder = WITHOUT_A_GPU, tmp_path_factory.mktemp("stub")
    if importlib.util.find_spec("cuda") and importlib.util.find_spec("cuda.bindings"):
        code += THROUGH_THE_BINDINGS
        source = Path(__file__).with_name("driver_stub.cpp")
        compiler, library = os.environ.get("CXX", "c++"), folder / "libcuda.so.1"
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", source, "-o", library], check=True)
    environment = os.environ | {
        "LD_LIBRARY_PATH": str(folder),
        "PYTHONPATH": str(Path(snowsplat.__file__).parents[1]),
    }
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    return result.stdout.splitlines(), result.stderr


@pytest.mark.build
def test_the_driver_is_not_loaded_for_the_cpu(new_process):
    lines, errors = new_process
    assert lines[:1] == ["0 0 []"], errors


@pytest.mark.build
def test_the_real_bindings_with_a_stub_driver(new_process):
    pytest.importorskip("cuda.bindings.driver")
    lines, errors = new_process
    assert lines[1:] == [
        "cuda:0: some_kernel: CUDA_ERROR_ILLEGAL_ADDRESS, an illegal memory access; "
        "update the NVIDIA driver, or use device cpu",
        "cuda:0: other_kernel: the built kernels do not match the Python files: "
        "rebuild them (make native)",
    ], errors


# ---- the code for a card


@pytest.mark.parametrize(
    ("capability", "cubin"),
    [
        ((7, 0), 70),
        ((7, 2), 70),
        ((7, 5), 75),
        ((8, 0), 80),
        ((8, 6), 86),
        ((8, 7), 86),
        ((8, 9), 89),
        ((9, 0), 90),
        ((10, 0), 100),
        ((10, 3), 100),
        ((12, 0), 120),
        ((12, 1), 120),
    ],
)
def test_the_nearest_built_cubin_comes_first(capability, cubin, built, compiler):
    codes = cubins.candidates("statistic", capability, 13)
    assert next(codes) == f"statistic {cubin}".encode()
    assert not compiler.compiled
    number = 10 * capability[0] + capability[1]
    target = f"sm_{number}" if number != 121 else "compute_120"  # not supported by the compiler
    assert list(codes) == [f"statistic for {target}, 1".encode()]


def test_for_another_major_version_kernels_are_compiled(built, compiler):
    # Not supported by this compiler: the driver compiles PTX for the newest supported one.
    assert list(cubins.candidates("statistic", (13, 0), 13)) == [b"statistic for compute_120, 1"]
    assert list(cubins.candidates("statistic", (11, 0), 13)) == [b"statistic for compute_103, 2"]
    assert list(cubins.candidates("statistic", (5, 0), 12)) == [b"statistic for sm_50, 3"]


def test_without_built_kernels_all_are_compiled(tmp_path, monkeypatch, compiler):
    monkeypatch.setattr(cubins, "_BUILT", tmp_path / "nothing")
    assert list(cubins.candidates("rasterize", (8, 6), 12)) == [b"rasterize for sm_86, 1"]


@pytest.mark.parametrize(
    ("capability", "major", "newest", "package"),
    [((13, 0), 12, 12, "nvrtc-cu12"), ((13, 0), 13, 13, "nvrtc"), ((7, 0), 13, 12, "nvrtc-cu12")],
)
def test_without_nvrtc_the_error_names_the_package(
    capability, major, newest, package, built, monkeypatch
):
    def nothing(majors):
        assert list(majors) == list(range(newest, 11, -1))
        raise nvrtc.NotFound

    monkeypatch.setattr(nvrtc, "find", nothing)
    assert next(cubins.candidates("rasterize", (8, 6), major)) == b"rasterize 86"
    with pytest.raises(
        UserError,
        match=rf"capability {capability[0]}.0, and .*: pip install nvidia-cuda-{package}$",
    ):
        list(cubins.candidates("rasterize", capability, major))


# ---- the cache


def compiled(capability: tuple[int, int] = (13, 0)) -> bytes:
    (code,) = cubins.candidates("statistic", capability, 12)
    return code


def test_compiled_code_is_cached(built, compiler, tmp_path):
    first = compiled()
    assert compiled() == first
    assert len(compiler.compiled) == 1
    (file,) = (tmp_path / "cache" / "snowsplat" / "kernels").iterdir()
    assert file.name.startswith("statistic-compute_120-")
    assert compiled((14, 0)) == first  # the same PTX
    assert compiled((11, 0)) != first


@pytest.mark.parametrize("damage", [b"", b"short", None, "cut", "changed"])
def test_a_damaged_file_is_compiled_again(damage, built, compiler, tmp_path):
    compiled()
    (file,) = (tmp_path / "cache" / "snowsplat" / "kernels").iterdir()
    whole = file.read_bytes()
    if damage is None:
        file.unlink()
    else:
        other = whole[:-1] + bytes([whole[-1] ^ 1])
        file.write_bytes({"cut": whole[:-1], "changed": other}.get(damage, damage))
    assert compiled().endswith(b", 2")
    assert compiled().endswith(b", 2")
    assert len(compiler.compiled) == 2


def test_an_unwritable_cache_is_not_an_error(built, compiler, tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file, where a folder should be")
    assert compiled().endswith(b", 1")
    assert compiled().endswith(b", 2")

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    assert compiled().endswith(b", 3")


def test_the_cache_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = tmp_path / ".cache" / "snowsplat" / "kernels" / "rasterize-sm_90-key"
    assert cubins._cache_path("rasterize", "sm_90", "key") == expected
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # must be ignored
    assert cubins._cache_path("rasterize", "sm_90", "key") == expected
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "Local"))
    assert (
        cubins._cache_path("a", "b", "c") == tmp_path / "Local" / "snowsplat" / "kernels" / "a-b-c"
    )


def test_the_key_depends_on_everything_that_affects_the_code(tmp_path, monkeypatch):
    source = tmp_path / "one.cu"
    (tmp_path / "one.h").write_text("// a header")
    source.write_text('#include "one.h"\n#include "cuda/device.h"\n')
    keys = [cubins._key((12, 9), "sm_90", source) for _ in range(2)]
    assert keys[0] == keys[1]
    keys = keys[:1]
    keys.append(cubins._key((12, 8), "sm_90", source))
    keys.append(cubins._key((12, 9), "sm_89", source))
    (tmp_path / "one.h").write_text("// another header")
    keys.append(cubins._key((12, 9), "sm_90", source))
    source.write_text('#include "one.h"\n#include "cuda/device.h"\n ')
    keys.append(cubins._key((12, 9), "sm_90", source))
    monkeypatch.setattr(nvrtc, "OPTIONS", ())
    keys.append(cubins._key((12, 9), "sm_90", source))
    assert len(set(keys)) == len(keys)


def test_a_real_compiler_fills_the_cache(tmp_path, monkeypatch):
    try:
        nvrtc.find()
    except nvrtc.NotFound:
        pytest.skip("needs NVRTC")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cubins, "_BUILT", tmp_path)
    monkeypatch.setattr(cubins, "_nvrtc", cubins._nvrtc.__wrapped__)
    (code,) = cubins.candidates("statistic", (8, 6), 13)
    assert code.startswith(b"\x7fELF")
    assert list(cubins.candidates("statistic", (8, 6), 13)) == [code]
    (ptx,) = cubins.candidates("statistic", (99, 0), 13)
    assert b".visible .entry accumulate_screen_statistics_f64(" in ptx
    assert ptx.endswith(b"\0")  # the driver reads it as a C string
