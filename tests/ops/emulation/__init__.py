"""Runs CUDA kernels on the CPU: each `.cu` file is compiled as C++, with a fibre per thread.

The environment variable SNOWSPLAT_EMULATION=sanitized compiles with AddressSanitizer and
UndefinedBehaviorSanitizer (Python then needs LD_PRELOAD, see `make sanitized`), and
SNOWSPLAT_ORDER sets the order in which the threads of a block run: see cuda_emulation.h.
"""

import ctypes
import fcntl
import functools
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import torch

from snowsplat.ops.cuda import nvrtc
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util.native_layout import Fields, Layout

_HERE = Path(__file__).parent
_ROOT = _HERE.parents[2]
_NATIVE = _ROOT / "src" / "snowsplat" / "native"
_FLAGS = {
    "": [],
    "sanitized": [
        *("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"),
        # AddressSanitizer reports an access through a null pointer, too.
        "-fno-sanitize=null,object-size,vptr",
    ],
}
# The compiler itself does not run under the sanitizers.
_ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}


def _compile(target: Path, made_of: Sequence[Path], arguments: Sequence[str | Path]) -> None:
    """Compiles as C++, if one of the files has changed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        newest = max(path.stat().st_mtime for path in made_of)
        if not target.exists() or target.stat().st_mtime < newest:
            command = [os.environ.get("CXX", "c++"), "-std=c++17", "-fPIC", "-Wall", "-Wextra"]
            command += ["-Werror", "-DSNOWSPLAT_EMULATION", f"-I{_HERE}", f"-I{_NATIVE}"]
            command += [*map(str, arguments), "-o", str(target)]
            made = subprocess.run(command, env=_ENVIRONMENT, capture_output=True, text=True)
            assert made.returncode == 0, f"{target.name} cannot be compiled:\n{made.stderr}"


@functools.cache
def library(file: str, float64: bool) -> ctypes.CDLL:
    """The float64 kernels, or the others, of `native/cuda/<file>.cu` or a file in this folder."""
    kind = os.environ.get("SNOWSPLAT_EMULATION", "")
    folder = _ROOT / "build" / "emulation" / (kind or "plain")
    target, source = folder / f"{file}{'_f64' * float64}.so", nvrtc.path_of(file)
    if not source.exists():
        source = _HERE / f"{file}.cu"
    header, block = _HERE / "cuda_emulation.h", folder / "block.o"
    options = ["-O2", "-g1", f"-DSNOWSPLAT_EMULATE_FLOAT64={int(float64)}"]
    if kind:
        options.append(f"-DSNOWSPLAT_{kind.upper()}")
    _compile(block, [_HERE / "block.cpp", header], [*options, "-c", _HERE / "block.cpp"])
    options += ["-shared", "-ffp-contract=fast", "-Wno-unknown-pragmas"]  # for unrolling
    arguments = [*options, *_FLAGS[kind], block, "-x", "c++", source]
    _compile(target, [*nvrtc.sources(source), header, block], arguments)
    loaded = ctypes.CDLL(str(target))
    loaded.emulate.restype = ctypes.c_char_p
    return loaded


def execute(kernel: Kernel, name: str, blocks: int, fields: Fields) -> None:
    """Runs a kernel on CPU tensors until it ends.

    Raises:
        RuntimeError: a divergent barrier, or another fault that the emulation detects.
        AssertionError: threads do not match the kernel.
    """
    loaded = library(kernel.file, name.endswith("_f64"))
    built = getattr(loaded, f"{name}_threads")()
    assert built == kernel.threads, f"{name} has {built} threads, its Kernel says {kernel.threads}"
    describe = getattr(loaded, f"{name}_fields")
    describe.restype = ctypes.c_char_p
    layout = Layout(describe().decode())
    for value in fields.values():
        assert not isinstance(value, torch.Tensor) or value.device.type == "cpu"
    struct = ctypes.create_string_buffer(layout.size)
    layout.pack_into(struct, name, fields)
    pointers = (ctypes.c_void_p * 1)(ctypes.addressof(struct))
    call = getattr(loaded, f"{name}_call")
    wrong = loaded.emulate(call, ctypes.c_int64(blocks), ctypes.c_int64(kernel.threads), pointers)
    if wrong is not None:
        raise RuntimeError(f"{name}: {wrong.decode()}")
