"""Checks whether a GPU can be used, and if not, explains why; `inventory` is for doctor."""

import ctypes
import functools
import importlib
import re
import sys
import warnings
from contextlib import suppress
from typing import Any

import torch

from snowsplat.ops.cuda import availability, cubins, nvrtc

OLDEST = (7, 0)  # oldest architecture of the kernels: see CMakeLists.txt

# Errors of cuInit: there is no GPU; the library is a stub, which is only for linking.
_NO_DEVICE, _STUB_LIBRARY = 100, 34


@functools.cache
def why_unusable(index: int = 0) -> str | None:
    """The reason why cuda:`index` cannot be used, and the remedy; None: it can be used.

    The text has no full stop at its end.
    """
    if torch.version.cuda is None:
        return "this PyTorch is built without CUDA; install one with it (see pytorch.org)"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        usable = torch.cuda.is_available()
    if not usable:
        return _why_torch_cannot(torch.version.cuda, [str(w.message) for w in caught])
    count = torch.cuda.device_count()
    if index >= count:
        return f"there is no cuda:{index}; this machine has " + (
            "only cuda:0" if count == 1 else f"cuda:0 to cuda:{count - 1}"
        )
    name, capability = torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index)
    shown = f"{name} (compute capability {capability[0]}.{capability[1]})"
    if capability < OLDEST:
        return f"{shown} is too old; use one of {OLDEST[0]}.{OLDEST[1]} (2017) or newer"
    if not _torch_runs_on(capability):
        return (
            f"this PyTorch, for CUDA {torch.version.cuda}, has no kernels for {shown}; "
            "install another PyTorch (see pytorch.org)"
        )
    try:
        importlib.import_module("cuda.bindings.driver")
    except ImportError:
        return "the package cuda-bindings is missing: pip install cuda-bindings"
    return None


def has_gpu() -> bool:
    """Whether the machine has an NVIDIA GPU and a driver, even if they cannot be used."""
    found = _driver()
    return found is not None and found.error != _NO_DEVICE


def driver_cuda() -> str | None:
    """The CUDA version of the driver, such as "12.8"; None without a driver."""
    found = _driver()
    return None if found is None else "{}.{}".format(*found.cuda)


class _Driver:
    """State and version of the driver, read directly because torch does not report them."""

    def __init__(self, library: ctypes.CDLL) -> None:
        version = ctypes.c_int(0)
        library.cuDriverGetVersion(ctypes.byref(version))
        self.error = int(library.cuInit(0))
        self.cuda = (version.value // 1000, version.value % 1000 // 10)


@functools.cache
def _driver() -> _Driver | None:
    try:
        driver = _Driver(ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"))
    except (OSError, AttributeError):
        return None
    return None if driver.error == _STUB_LIBRARY else driver


def _why_torch_cannot(torch_cuda: str, messages: list[str]) -> str:
    driver = _driver()
    if driver is None:
        return "there is no NVIDIA driver; install one if there is an NVIDIA GPU"
    if driver.error == _NO_DEVICE:
        return "the driver finds no NVIDIA GPU"
    if driver.error:
        return (
            f"the NVIDIA driver fails (error {driver.error}); restart the machine or reinstall it"
        )
    if driver.cuda[0] < int(torch_cuda.split(".")[0]):
        return (
            f"the NVIDIA driver is too old: it supports CUDA {driver.cuda[0]}.{driver.cuda[1]} and "
            f"this PyTorch needs {torch_cuda}; update the driver, or install a PyTorch for an "
            "older CUDA (see pytorch.org)"
        )
    reason = messages[0].partition("(Triggered internally")[0] if messages else ""
    reason = " ".join(reason.split()) or "torch.cuda.is_available() is false"
    return f"PyTorch cannot use it: {reason}"


def _torch_runs_on(capability: tuple[int, int]) -> bool:
    # "sm_86" runs on GPUs of the same major version from 8.6 on, "compute_86" on all GPUs from 8.6
    # on.
    known = [
        re.fullmatch(r"(sm|compute)_(\d+)(\d)[af]?", text) for text in torch.cuda.get_arch_list()
    ]
    built = [(match[1], (int(match[2]), int(match[3]))) for match in known if match]
    return not built or any(
        lowest <= capability and (kind == "compute" or lowest[0] == capability[0])
        for kind, lowest in built
    )


def inventory() -> dict[str, Any]:
    """The version of PyTorch, and what is known about GPUs. All values are values of JSON.

    The reason why a GPU cannot be used is `availability.why_unusable`.
    """
    why = availability.why_unusable()
    count = torch.cuda.device_count() if torch.version.cuda and torch.cuda.is_available() else 0
    return {
        "torch": torch.__version__,
        "torch_cuda": torch.version.cuda,
        "devices": [_device(index) for index in range(count)],
        "why_unused": why,
        "has_gpu": availability.has_gpu(),
        "driver": _driver_version(),
        "driver_cuda": availability.driver_cuda(),
        "kernels_for": cubins.built_for(),
        "nvrtc": _nvrtc_version(),
    }


def _device(index: int) -> dict[str, Any]:
    facts: dict[str, Any] = {"name": torch.cuda.get_device_name(index)}
    facts["compute_capability"] = "{}.{}".format(*torch.cuda.get_device_capability(index))
    facts["memory_bytes"] = torch.cuda.get_device_properties(index).total_memory
    facts["why_unused"] = availability.why_unusable(index)
    with suppress(RuntimeError):  # other programs may use all of the memory
        facts["free_bytes"] = torch.cuda.mem_get_info(index)[0]
    return facts


def _driver_version() -> str | None:
    """The version of the NVIDIA driver, such as "570.86.10"; None if there is none."""
    try:
        library = ctypes.CDLL("nvml.dll" if sys.platform == "win32" else "libnvidia-ml.so.1")
        text = ctypes.create_string_buffer(96)
        if library.nvmlInit_v2() or library.nvmlSystemGetDriverVersion(text, 96):
            return None
    except (OSError, AttributeError):
        return None
    return text.value.decode(errors="replace")


def _nvrtc_version() -> str | None:
    try:
        return "{}.{}".format(*nvrtc.Nvrtc(nvrtc.find()).version)
    except (nvrtc.NotFound, nvrtc.CompileError, OSError):
        return None
