"""`Compute`: the device, the number of threads, and whether a GPU sums in a fixed order."""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.util.errors import SettingError

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Compute:
    """The device and the number of threads for a computation.

    Attributes:
        device: "cpu", "cuda" or "cuda:1"; None: a GPU if a usable one is present.
        threads: number of CPU threads; None: all cores. Results do not depend on this number.
        deterministic: on a GPU, compute sums in a fixed order. Results are then bit-identical in
            every run, but this needs more time and memory.

    Raises:
        UserError: fewer than 1 thread.
    """

    device: str | None = None
    threads: int | None = None
    deterministic: bool = False

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise SettingError("threads", f"{self.threads} is too small; use at least 1")

    def apply(self) -> torch.device:
        """Apply these settings to the process; returns the device.

        If a GPU is present but unusable and no device was requested, the reason is logged.

        Raises:
            UserError: the device is missing or unusable.
        """
        from snowsplat import ops

        # The tensors of a growing scene are each a little larger than the one before, which
        # fragments the memory of a GPU. PyTorch reads this variable at the first allocation.
        if sys.platform == "linux":
            os.environ.setdefault("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True")
        if self.threads is not None:
            ops.set_num_threads(self.threads)
        device = ops.resolve_device(self.device, note=logger.info)
        if self.deterministic:
            _sum_in_a_fixed_order()
        return device


def _sum_in_a_fixed_order() -> None:
    import torch

    # Required by cuBLAS, which reads it at its first use.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    # As torch.use_deterministic_algorithms, which would also import PyTorch's compiler, in 2 s.
    torch.set_deterministic_debug_mode("warn")
    # Otherwise PyTorch fills all new memory, to make reads of uninitialized memory repeatable.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
