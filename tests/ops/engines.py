"""Runs GPU kernels with CPU tensors, so that a test works for every engine."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from snowsplat.ops.cuda import driver
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.cuda.launches import launch_by
from snowsplat.ops.webgpu import adapter, backend
from snowsplat.ops.webgpu import launches as webgpu
from snowsplat.ops.webgpu.tensor import from_host
from snowsplat.util.native_layout import Fields

from . import emulation


def launcher(engine: str) -> Callable[[str, Fields], int]:
    """A value for `native.LAUNCHERS["cpu"]`. Tests are skipped without the device of the engine."""
    if engine == "webgpu":
        if (why := adapter.why_unusable()) is not None:
            pytest.skip(f"webgpu: {why}")
        backend.enable()
        return launch_on_webgpu
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


def launch_on_webgpu(name: str, fields: Fields) -> int:
    """`ops.webgpu.launches.launch` with tensors of the CPU, whose memory it changes."""
    given = {id(value): value for value in fields.values() if isinstance(value, torch.Tensor)}
    wrapped = {key: from_host(value.detach()) for key, value in given.items()}
    memories = {
        value.untyped_storage().data_ptr(): wrapped[key].memory for key, value in given.items()
    }
    for key, value in given.items():
        wrapped[key].memory = memories[value.untyped_storage().data_ptr()]
    on_device = {key: wrapped.get(id(value), value) for key, value in fields.items()}
    result = webgpu.launch(name, on_device)
    for key, value in given.items():
        storage = torch.empty(0, dtype=torch.uint8).set_(value.untyped_storage())
        storage.copy_(wrapped[key].memory.host()[: len(storage)])
    return result


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
