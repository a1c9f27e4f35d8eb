"""`inventory`: PyTorch, the GPUs, and the kernels for them, for `snowsplat doctor`."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress
from typing import Any

import torch

from snowsplat.ops.cuda import availability, cubins, nvrtc


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
