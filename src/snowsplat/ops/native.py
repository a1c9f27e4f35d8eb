"""Launches native functions on the CPU or on a GPU. Only this module distinguishes devices.

At the first launch on the CPU, `util/native_library.py` loads the library for the best instruction
set. A GPU has the same entries: see `ops/cuda`.
"""

from __future__ import annotations

import ctypes
import functools
import threading
from collections.abc import Callable
from typing import Any

import torch

from snowsplat.ops import cuda
from snowsplat.ops.params import ENTRIES
from snowsplat.util import native_library
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import LARGEST_PARAMS, Params, layout_of
from snowsplat.util.native_library import ISAS, available_isas, outdated, set_num_threads

# The functions that have been launched, and their structs.
_functions: dict[str, tuple[Callable[[Any], int], type[Params]]] = {}
_int = ctypes.c_int64

__all__ = [
    "ISAS",
    "LAUNCHERS",
    "available_isas",
    "get_num_threads",
    "isa",
    "launch",
    "set_num_threads",
]


@functools.cache
def _library() -> tuple[str, ctypes.CDLL]:
    isa, library = native_library.library()
    native_library.check_layouts(ENTRIES)
    return isa, library


def isa() -> str:
    """The instruction set of the library in use: "avx512", "avx2" or "baseline" (NEON on Arm)."""
    return _library()[0]


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
        raise outdated(isa, name)
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
        raise UserError(
            "there are no kernels for device {device}; use device cpu or cuda", device=device
        )
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
