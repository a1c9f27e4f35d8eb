"""Launches native functions on the CPU or on a GPU. Only this module distinguishes devices.

At the first launch on the CPU, `util/native_library.py` loads the library for the best instruction
set. A GPU has the same entries: see `ops/cuda` and `ops/webgpu`.
"""

from collections.abc import Callable
from typing import Any

import torch

from snowsplat.ops import cuda, webgpu
from snowsplat.util import native_library
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import Fields
from snowsplat.util.native_library import ISAS, available_isas, set_num_threads

__all__ = [
    "ISAS",
    "LAUNCHERS",
    "Struct",
    "available_isas",
    "get_num_threads",
    "isa",
    "launch",
    "query_size",
    "set_num_threads",
]


def isa() -> str:
    """The instruction set in use: "avx512", "avx2" or "baseline" (NEON on Arm)."""
    return native_library.library()[0]


def get_num_threads() -> int:
    """The number of threads that the kernels use.

    Initially SNOWSPLAT_THREADS, or else the number of processors that this process may use.
    """
    return int(native_library.library()[1].get_num_threads())


#: The fields of a nested struct of `native/params.h`.
Struct = dict[str, Any]


def launch(name: str, /, *, device: torch.device | None = None, **fields: Any) -> int:
    """Calls the native function `name` with its parameters, and returns its int64 result.

    `native/params.h` documents the parameters: a tensor or None, a number, or a dict with the
    fields of a nested struct. The tensors must be contiguous and on one device; the function runs
    on this device. `device` is needed if there is no tensor. Element types are not checked here:
    the function for float64 tensors has the suffix `_f64`. On the CPU the interpreter lock is
    released during the call; on a GPU the call is queued on torch's current stream.

    Raises:
        UserError: a device without kernels, or the library does not have these parameters.
        ValueError: tensors that are not contiguous or not on one device.
        TypeError: a parameter of another type.
    """
    flat: dict[str, Any] = {}
    for field, value in fields.items():
        if isinstance(value, dict):
            flat.update((f"{field}.{inner}", each) for inner, each in value.items())
        else:
            flat[field] = value
    for field, value in flat.items():
        if not isinstance(value, torch.Tensor):
            continue
        if device is None:
            device = value.device
        elif value.device != device:
            raise ValueError(
                f"{name}: {field} is on {value.device}, other tensors are on {device}; "
                "move them to one device"
            )
        if not value.is_contiguous():
            raise ValueError(f"{name}: {field} of shape {tuple(value.shape)} is not contiguous")
    launcher = LAUNCHERS.get("cpu" if device is None else device.type)
    if launcher is None:
        raise UserError(
            "there are no kernels for device {device}; use device cpu or cuda", device=device
        )
    return launcher(name, flat)


def query_size(name: str, device: torch.device, n: int = 0, tiles: int = 0, parts: int = 0) -> int:
    """The result of a function that returns a size, such as that of a scratch tensor."""
    return launch(name, device=device, n=n, tiles=tiles, parts=parts)


#: For each type of device, calls a function with the fields of its struct; see `native_layout`.
LAUNCHERS: dict[str, Callable[[str, Fields], int]] = {
    "cpu": native_library.call,
    "cuda": cuda.launch,
    "webgpu": webgpu.launch,
}
