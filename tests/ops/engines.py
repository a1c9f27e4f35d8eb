"""Runs GPU kernels with CPU tensors, so that a test works for every engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch

from snowsplat.ops.cuda import driver
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.cuda.launches import launch_by
from snowsplat.util.native_layout import Params

from . import emulation


def launcher(engine: str) -> Callable[[str, Params], int]:
    """A value for `native.LAUNCHERS["cpu"]`. Tests of "cuda" are skipped without a GPU."""
    if engine == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use")
    execute = emulation.execute if engine == "emulated" else execute_on_gpu
    return lambda name, params: launch_by(execute, name, params)


def execute_on_gpu(kernel: Kernel, name: str, blocks: int, params: Params) -> None:
    """Copies the tensors to the GPU, runs the kernel, and copies all of them back."""
    copies: list[tuple[torch.Tensor, torch.Tensor]] = []
    driver.run(kernel, name, blocks, _copied(params, copies))
    for tensor, copy in copies:
        tensor.copy_(copy)


def _copied(value: Any, copies: list[tuple[torch.Tensor, torch.Tensor]]) -> Any:
    if isinstance(value, torch.Tensor):
        copies.append((value, value.cuda()))
        return copies[-1][1]
    if isinstance(value, Params):
        names = [field.name for field in fields(value)]  # type: ignore[arg-type]
        return replace(value, **{name: _copied(getattr(value, name), copies) for name in names})
    return value
