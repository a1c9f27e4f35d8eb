"""Launches native functions, on the CPU or on a GPU: the only place where the device decides.

The CPU has one shared library per instruction set in `snowsplat/_lib`. All have the same entries,
plain C functions of `(int64 n, pointers, int64s, doubles) -> int64`. The best one that the machine
runs is loaded at the first launch; the environment variable SNOWSPLAT_ISA (avx512, avx2 or
baseline) forces one. A GPU has the same entries: see `ops/cuda`.
"""

from __future__ import annotations

import ctypes
import functools
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from snowsplat.ops import cuda
from snowsplat.ops.cuda.kernels import Argument
from snowsplat.util.errors import UserError

# Worst to best. The position of a name is the number that native/cpu/isa.cpp knows it by.
ISAS = ("baseline", "avx2", "avx512")

_LIBRARIES = Path(__file__).resolve().parent.parent / "_lib"
_lock = threading.RLock()
_functions: dict[str, Callable[..., int]] = {}

_int = ctypes.c_int64
_double = ctypes.c_double
_pointer = ctypes.c_void_p


def _open(isa: str) -> ctypes.CDLL:
    """The library of one instruction set. Its calls release the interpreter lock."""
    path = _LIBRARIES / f"libsnowsplat_{isa}.so"
    if not path.exists():
        raise UserError(
            f"the native library {path.name} is missing; in a checkout `make native` builds it, "
            "elsewhere `pip install .` does"
        )
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise UserError(
            f"the native library {path} cannot be loaded ({error}); rebuild it"
        ) from error


@functools.cache
def available_isas() -> tuple[str, ...]:
    """The instruction sets that are built and that this machine runs, worst first."""
    best = _open("baseline").best_isa()
    built = (isa for isa in ISAS if (_LIBRARIES / f"libsnowsplat_{isa}.so").exists())
    return tuple(isa for isa in built if ISAS.index(isa) <= best)


def _choose() -> str:
    forced = os.environ.get("SNOWSPLAT_ISA", "")
    if not forced:
        return available_isas()[-1]
    if forced not in ISAS:
        raise UserError(
            f"SNOWSPLAT_ISA={forced!r} is no instruction set; use one of {', '.join(ISAS)}"
        )
    if forced not in available_isas():
        raise UserError(
            f"SNOWSPLAT_ISA={forced} does not run here; this machine and this build have "
            f"{', '.join(available_isas())}"
        )
    return forced


@functools.cache
def _library() -> tuple[str, ctypes.CDLL]:
    with _lock:
        isa = _choose()
        library = _open(isa)
        library.set_num_threads(_int(_default_threads()))
        return isa, library


def isa() -> str:
    """The instruction set of the library in use: "avx512", "avx2" or "baseline" (NEON on Arm)."""
    return _library()[0]


def _default_threads() -> int:
    asked = os.environ.get("SNOWSPLAT_THREADS", "")
    if not asked:
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if not asked.isdecimal() or int(asked) < 1:
        raise UserError(f"SNOWSPLAT_THREADS={asked!r} is no number of threads; use 1 or more")
    return int(asked)


def set_num_threads(threads: int) -> None:
    """Let the kernels use `threads` threads. The results do not depend on it, to the bit."""
    if threads < 1:
        raise UserError(f"the number of threads must be 1 or more, not {threads}")
    _library()[1].set_num_threads(_int(threads))


def get_num_threads() -> int:
    """How many threads the kernels use.

    At first SNOWSPLAT_THREADS, or else as many as there are processors that this process may use.
    """
    return int(_library()[1].get_num_threads())


def _function(name: str) -> Callable[..., int]:
    isa, library = _library()
    try:
        function = getattr(library, name)
    except AttributeError:
        raise UserError(
            f"the native library for {isa} has no function {name}; it is older than the Python "
            "files: rebuild it (`make native`)"
        ) from None
    function.restype = _int
    _functions[name] = function
    return function


def launch(name: str, n: int, *args: Argument, device: torch.device | None = None) -> int:
    """Call the native function `name(n, *args)` and return its int64 result.

    Tensors go as data pointers, None as a null pointer, int and bool as int64, float as double. The
    tensors must be contiguous and on one device, which decides where the function runs; `device`
    names it where no tensor does. Element types are the caller's business: a function for float64
    tensors has the suffix `_f64`. The interpreter lock is released during the call on the CPU; on
    a GPU the call is queued on torch's current stream.

    Raises UserError for a device without kernels, ValueError for tensors that are not contiguous or
    not on one device, TypeError for any other argument.
    """
    for position, arg in enumerate(args, start=1):
        if isinstance(arg, torch.Tensor):
            if device is None:
                device = arg.device
            elif arg.device != device:
                raise ValueError(
                    f"{name}: tensors on {device} and on {arg.device}; move them to one device"
                )
            if not arg.is_contiguous():
                raise ValueError(
                    f"{name}: argument {position} of shape {tuple(arg.shape)} is not contiguous"
                )
        elif not (arg is None or isinstance(arg, (int, float))):
            raise TypeError(
                f"{name}: argument {position} is a {type(arg).__name__}, "
                "not a tensor, int, float or None"
            )
    launcher = LAUNCHERS.get("cpu" if device is None else device.type)
    if launcher is None:
        raise UserError(f"there are no kernels for device {device}; use device cpu or cuda")
    return launcher(name, n, args)


def _launch_cpu(name: str, n: int, args: Sequence[Argument]) -> int:
    function = _functions.get(name) or _function(name)
    values: list[object] = [_int(n)]
    for arg in args:
        # Wrapped one by one rather than through argtypes: a bare int would be cut to 32 bits.
        if isinstance(arg, torch.Tensor):
            values.append(_pointer(arg.data_ptr()))
        elif arg is None:
            values.append(_pointer())
        elif isinstance(arg, int):
            values.append(_int(arg))
        else:
            values.append(_double(arg))
    return function(*values)


LAUNCHERS: dict[str, Callable[[str, int, Sequence[Argument]], int]] = {
    "cpu": _launch_cpu,
    "cuda": cuda.launch,
}
