"""What runs the kernels of a GPU under CPU tensors, so that one test body serves every engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch

from snowsplat.ops.cuda import driver
from snowsplat.ops.cuda.kernels import Argument, Kernel
from snowsplat.ops.cuda.launches import launch_by

from . import emulation


def launcher(engine: str) -> Callable[[str, int, Sequence[Argument]], int]:
    """For `native.LAUNCHERS["cpu"]`. Without a GPU the tests of "cuda" are skipped."""
    if engine == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    execute = emulation.execute if engine == "emulated" else execute_there
    return lambda name, n, args: launch_by(execute, name, n, args)


def execute_there(kernel: Kernel, name: str, blocks: int, args: Sequence[Argument]) -> None:
    """Takes the tensors to the GPU, runs the kernel, and brings all of them back."""
    there = [arg.cuda() if isinstance(arg, torch.Tensor) else arg for arg in args]
    driver.run(kernel, name, blocks, there)
    for arg, result in zip(args, there, strict=True):
        if isinstance(arg, torch.Tensor):
            arg.copy_(result)
