"""Runs GPU kernels with CPU tensors, so that a test works for every engine."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from snowsplat.ops.cuda import driver
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.cuda.launches import launch_by
from snowsplat.util.native_layout import Fields

from . import emulation


def launcher(engine: str) -> Callable[[str, Fields], int]:
    """A value for `native.LAUNCHERS["cpu"]`. Tests of "cuda" are skipped without a GPU."""
    if engine == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    execute = emulation.execute if engine == "emulated" else execute_on_gpu
    return lambda name, fields: launch_by(execute, name, fields)


def execute_on_gpu(kernel: Kernel, name: str, blocks: int, fields: Fields) -> None:
    """Copies the memory of the tensors to the GPU, runs the kernel, and copies it back.

    Tensors that share memory here share it there. torch does not notice that the memory changed, as
    it does not notice that for the kernels of the CPU.
    """
    copies: dict[int, _Copy] = {}
    copied = {field: _copied(value, copies) for field, value in fields.items()}
    driver.run(kernel, name, blocks, copied)
    for copy in copies.values():
        copy.here.copy_(copy.there)


class _Copy:
    def __init__(self, here: torch.UntypedStorage) -> None:
        self.here, self.there = here, here.cuda()


def _copied(value: Any, copies: dict[int, _Copy]) -> Any:
    if isinstance(value, torch.Tensor):
        here = value.untyped_storage()
        if here.data_ptr() not in copies:
            copies[here.data_ptr()] = _Copy(here)
        there = torch.empty(0, dtype=value.dtype, device="cuda")
        memory = copies[here.data_ptr()].there
        return there.set_(memory, value.storage_offset(), value.shape, value.stride())
    return value
