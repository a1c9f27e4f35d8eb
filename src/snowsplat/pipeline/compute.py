"""`Compute`: the device, the number of threads, and whether sums on a GPU have a fixed order.

The flags of `train` use this module: torch is imported in the functions that need it.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.pipeline.run import processes
from snowsplat.util.settings import Settings, flag, setting, switch

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)

_DEVICE = re.compile(r"(cpu|cuda)(:\d+)?|webgpu")


@dataclass(frozen=True)
class Compute(Settings):
    """The device and the number of threads for a computation.

    Attributes:
        device: "cpu", "cuda", "cuda:1" or "webgpu"; None: an NVIDIA GPU if a usable one is
            present.
        threads: None: all cores, divided between the processes that train together on this
            computer.
        deterministic: the sums on a GPU have a fixed order. On a CPU, results are always
            bit-identical.

    Raises:
        SettingError: an unknown device, or fewer than 1 thread.
    """

    device: str | None = setting(
        None,
        "Device to compute on.",
        "a GPU if there is one",
        metavar="{cuda,cuda:N,cpu,webgpu}",
        allowed="cpu, cuda, cuda:1 or webgpu",
        check=lambda device: None if _DEVICE.fullmatch(device) else "is unknown",
    )
    threads: int | None = flag(
        None,
        "Number of CPU threads. The result does not depend on this number.",
        "all cores",
        least=1,
    )
    deterministic: bool = switch(
        "On a GPU, make the results of repeated runs bit-identical. This needs more time and "
        "memory."
    )

    def apply(self) -> torch.device:
        """Apply these settings to the process; returns the device.

        If a GPU is present but unusable and no device was requested, the reason is logged.

        Raises:
            UserError: the device is missing or unusable.
        """
        import torch

        from snowsplat import ops

        # While a scene grows, each new tensor is a little larger than the old one. This fragments
        # the memory of a GPU, unless its segments can be expanded. PyTorch reads this variable at
        # the first allocation.
        if sys.platform == "linux":
            os.environ.setdefault("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True")
        if self.threads is not None:
            ops.set_num_threads(self.threads)
        elif processes.local_count() > 1:
            ops.set_num_threads(max(1, ops.get_num_threads() // processes.local_count()))
        device = ops.resolve_device(self.device, note=logger.info)
        if device.type == "cuda" and device.index is None and processes.count() > 1:
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        if self.deterministic:
            _sum_in_a_fixed_order()
        return device


def open_device(device: torch.device) -> None:
    """Open a GPU in the background, which takes half a second. Meanwhile, files can be read.

    An error is that of the first use in the foreground.
    """
    import torch

    def use() -> None:
        with suppress(RuntimeError):
            torch.zeros(1, device=device)

    if device.type == "cuda":
        threading.Thread(target=use, name="snowsplat-open-device").start()


def _sum_in_a_fixed_order() -> None:
    import torch

    # cuBLAS requires this variable, and reads it at its first use.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    # The same as torch.use_deterministic_algorithms(True, warn_only=True), which would also import
    # PyTorch's compiler (2 s).
    torch.set_deterministic_debug_mode("warn")
    # By default, PyTorch then also fills all uninitialised memory, which takes time.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
