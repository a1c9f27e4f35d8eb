"""The flags `--device` and `--threads`: what a verb computes with."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import torch


def check_threads(threads: int | None) -> None:
    """Raises: UserError: none at all."""
    if threads is not None and threads < 1:
        raise UserError(f"--threads is {threads}; it must be at least 1")


def compute_with(threads: int | None, device: str | None) -> torch.device:
    """Set the number of threads, and give the device to compute on.

    Where there is a GPU that cannot be used, and none was asked for, a line on the error stream
    says why.

    Raises:
        UserError: a device that is not there, or cannot be used; no threads at all.
    """
    from snowsplat import ops

    # Tensors of a scene that grows are each a little larger than the one before: without this the
    # memory of a GPU fills with holes. Read when it is used first.
    if sys.platform == "linux":
        os.environ.setdefault("PYTORCH_CUDA_ALLOC_CONF", "expandable_segments:True")
    check_threads(threads)
    if threads is not None:
        ops.set_num_threads(threads)
    return ops.resolve_device(device, note=_note)


def ask_for_the_same_bits() -> None:
    """From now on a GPU sums in a fixed order."""
    import torch

    # What cuBLAS asks for; it looks when it is used first.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    # Otherwise torch fills all new memory, for those who read what they have not written.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def _note(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
