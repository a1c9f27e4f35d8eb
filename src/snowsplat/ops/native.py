"""Launches native functions on the CPU or on a GPU. Only this module distinguishes devices.

The CPU has one shared library per instruction set in `snowsplat/_lib`. All have the same entries:
C functions that take a pointer to a struct of parameters (`ops/params.py`) and return an int64. At
the first launch, the best library that the machine supports is loaded. The environment variable
SNOWSPLAT_ISA (avx512, avx2 or baseline) selects another one. A GPU has the same entries: see
`ops/cuda`.
"""

from __future__ import annotations

import ctypes
import functools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from snowsplat.ops import cuda
from snowsplat.ops.layout import LARGEST_PARAMS, Params, layout_of
from snowsplat.ops.params import ENTRIES
from snowsplat.util.errors import UserError

# Worst to best. The index of a name is its number in native/cpu/isa.cpp.
ISAS = ("baseline", "avx2", "avx512")

_LIBRARIES = Path(__file__).resolve().parent.parent / "_lib"
_lock = threading.RLock()
# The functions that have been launched, and their structs.
_functions: dict[str, tuple[Callable[[Any], int], type[Params]]] = {}
_int = ctypes.c_int64


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
    """The instruction sets that are built and that this machine supports, worst first."""
    best = _open("baseline").best_isa()
    built = (isa for isa in ISAS if (_LIBRARIES / f"libsnowsplat_{isa}.so").exists())
    return tuple(isa for isa in built if ISAS.index(isa) <= best)


def _choose() -> str:
    forced = os.environ.get("SNOWSPLAT_ISA", "")
    if not forced:
        return available_isas()[-1]
    if forced not in ISAS:
        raise UserError(
            f"SNOWSPLAT_ISA={forced!r} is not an instruction set; use one of {', '.join(ISAS)}"
        )
    if forced not in available_isas():
        raise UserError(
            f"SNOWSPLAT_ISA={forced} is not supported here; this machine and this build have "
            f"{', '.join(available_isas())}"
        )
    return forced


@functools.cache
def _library() -> tuple[str, ctypes.CDLL]:
    with _lock:
        isa = _choose()
        library = _open(isa)
        _check_layouts(isa, library)
        library.set_num_threads(_int(_default_threads()))
        return isa, library


def _check_layouts(isa: str, library: ctypes.CDLL) -> None:
    """Raises UserError unless the structs of the library are those of `ops/params.py`."""
    for entry, params in ENTRIES.items():
        for name in (entry, entry + "_f64"):
            try:
                layout = getattr(library, name + "_layout")
            except AttributeError:
                if name != entry:
                    continue  # has no variant for float64
                raise _outdated(isa, name) from None
            layout.restype = ctypes.c_uint64
            if layout() != layout_of(params).hash:
                raise _outdated(isa, name)


def _outdated(isa: str, name: str) -> UserError:
    return UserError(
        f"the native library for {isa} does not match the Python files ({name}); "
        "rebuild it: `make native` in a checkout, `pip install .` elsewhere"
    )


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
        raise UserError(f"SNOWSPLAT_THREADS={asked!r} is not a number of threads; use 1 or more")
    return int(asked)


def set_num_threads(threads: int) -> None:
    """Sets the number of threads that the kernels use. Results are bit-identical for any number."""
    if threads < 1:
        raise UserError(f"the number of threads must be 1 or more, not {threads}")
    _library()[1].set_num_threads(_int(threads))


def get_num_threads() -> int:
    """The number of threads that the kernels use.

    Initially SNOWSPLAT_THREADS, or else the number of processors that this process may use.
    """
    return int(_library()[1].get_num_threads())


def _function(name: str) -> tuple[Callable[[Any], int], type[Params]]:
    isa, library = _library()
    params = ENTRIES.get(name.removesuffix("_f64"))
    function = getattr(library, name, None)
    if params is None or function is None:
        raise _outdated(isa, name)
    function.restype, function.argtypes = _int, (ctypes.c_void_p,)
    _functions[name] = function, params
    return _functions[name]


def launch(name: str, params: Params, *, device: torch.device | None = None) -> int:
    """Calls the native function `name` with a struct of parameters, and returns its int64 result.

    The tensors of the struct must be contiguous and on one device; the function runs on this
    device. `device` is needed if there is no tensor. Element types are not checked here: the
    function for float64 tensors has the suffix `_f64`. On the CPU the interpreter lock is released
    during the call; on a GPU the call is queued on torch's current stream.

    Raises UserError for a device without kernels; ValueError for tensors that are not contiguous or
    not on one device; TypeError for the struct of another function or a field of another type.
    """
    layout = layout_of(type(params))
    values = layout.values(params)
    for i in layout.pointers:
        tensor = values[i]
        if tensor is None:
            continue
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(
                f"{name}: {layout.names[i]} must be a tensor or None, got {type(tensor).__name__}"
            )
        if device is None:
            device = tensor.device
        elif tensor.device != device:
            raise ValueError(
                f"{name}: {layout.names[i]} is on {tensor.device}, other tensors are on {device}; "
                "move them to one device"
            )
        if not tensor.is_contiguous():
            raise ValueError(
                f"{name}: {layout.names[i]} of shape {tuple(tensor.shape)} is not contiguous"
            )
    launcher = LAUNCHERS.get("cpu" if device is None else device.type)
    if launcher is None:
        raise UserError(f"there are no kernels for device {device}; use device cpu or cuda")
    return launcher(name, params)


class _Buffer(threading.local):
    """Memory for the struct of a launch; each thread has its own."""

    def __init__(self) -> None:
        self.bytes = ctypes.create_string_buffer(LARGEST_PARAMS)
        self.address = ctypes.addressof(self.bytes)


_buffer = _Buffer()


def _launch_cpu(name: str, params: Params) -> int:
    function, expected = _functions.get(name) or _function(name)
    if type(params) is not expected:
        raise TypeError(f"{name} takes {expected.__name__}, not {type(params).__name__}")
    buffer = _buffer
    layout_of(expected).pack_into(buffer.bytes, params)
    return function(buffer.address)


LAUNCHERS: dict[str, Callable[[str, Params], int]] = {
    "cpu": _launch_cpu,
    "cuda": cuda.launch,
}
