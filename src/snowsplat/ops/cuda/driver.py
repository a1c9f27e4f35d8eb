"""Runs kernels on a GPU, through its driver."""

from __future__ import annotations

from collections.abc import Sequence

from snowsplat.errors import UserError
from snowsplat.ops.cuda.kernels import Argument, Kernel


def run(kernel: Kernel, name: str, blocks: int, args: Sequence[Argument]) -> None:
    raise UserError("CUDA kernels are not built yet; use device cpu")
