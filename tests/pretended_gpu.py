"""A GPU that is not there: tensors that say they are on it, with their values in ordinary memory.

Every operation runs on the CPU, so a test sees its values. What CUDA refuses is refused: tensors of
two devices in one operation, a random generator of another device, and `Tensor.numpy`. Indices and
masks on the other device, which CUDA copies, are refused, too.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from snowsplat.ops.native import LAUNCHERS
from snowsplat.util import native_library
from snowsplat.util.native_layout import Fields

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
_ATEN = torch.ops.aten
#: They take tensors of two devices.
_COPIES = (_ATEN.copy_.default, _ATEN._to_copy.default)


class _OnGpu(Tensor):
    """A tensor on the pretended GPU; ``held`` has its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> _OnGpu:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device="meta",  # a guard for "cuda" would look for a driver
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    @property
    def device(self) -> torch.device:
        return GPU

    @property
    def is_cuda(self) -> bool:
        return True

    def __repr__(self, **kwargs: Any) -> str:
        return f"on the GPU: {self.held}"

    def data_ptr(self) -> int:
        return self.held.data_ptr()

    def tolist(self) -> Any:
        return self.held.tolist()


class _Functions(TorchFunctionMode):
    """Functions that look for a driver before they call an operation."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is Tensor.new_tensor and isinstance(args[0], _OnGpu):
            made = torch.tensor(args[1], **{"dtype": args[0].dtype, **kwargs})
            return made.to(GPU)
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            device = torch.device(kwargs.pop("device"))
            return func(*args, **kwargs).to(device)
        return func(*args, **kwargs)


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _held(value: Any) -> Any:
    if isinstance(value, torch.device):
        return CPU
    return value.held if isinstance(value, _OnGpu) else value


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    values = tree_flatten((args, kwargs))[0]
    there = [value for value in values if isinstance(value, _OnGpu)]
    here = [
        value
        for value in values
        if isinstance(value, Tensor) and not isinstance(value, _OnGpu) and value.dim() > 0
    ]
    if there and here and func not in _COPIES:
        shapes = [[tuple(tensor.shape) for tensor in side] for side in (there, here)]
        raise RuntimeError(
            f"{func}: expected all tensors to be on the same device, but {shapes[0]} are on {GPU} "
            f"and {shapes[1]} on the CPU"
        )
    kwargs = {name: value for name, value in kwargs.items() if name != "pin_memory"}
    device = kwargs.get("device")
    target = bool(there) if device is None else torch.device(device).type != "cpu"
    generator = kwargs.get("generator")
    if generator is not None and generator.device.type != ("cuda" if target else "cpu"):
        raise RuntimeError(f"{func}: expected a generator of the device of the result")
    result = func(*tree_map(_held, args), **tree_map(_held, kwargs))
    if func is _ATEN.copy_.default:
        return args[0]
    own = {id(value.held): value for value in there}  # of an operation in place

    def placed(value: Any) -> Any:
        if not isinstance(value, Tensor) or not target:
            return value
        return own[id(value)] if id(value) in own else _OnGpu(value)

    return tree_map(placed, result)


def _launch(name: str, fields: Fields) -> int:
    for field, value in fields.items():
        assert not isinstance(value, Tensor) or isinstance(value, _OnGpu), f"{name}: {field}"
    return native_library.call(name, {field: _held(value) for field, value in fields.items()})


class _Event:
    def record(self) -> None:
        """All work is done when it is queued."""

    synchronize = record


@contextmanager
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """A GPU in this block, in all threads that start there; its kernels are those of the CPU."""
    run = threading.Thread.run

    def run_in_mode(self: threading.Thread) -> None:
        with _Functions(), _Operations():
            run(self)

    if not torch.cuda.is_available():  # PyTorch calls it once in a process
        monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (1 << 30, 1 << 30))
    monkeypatch.setattr(torch.cuda, "Event", _Event)
    monkeypatch.setattr(threading.Thread, "run", run_in_mode)
    monkeypatch.setitem(LAUNCHERS, "cuda", _launch)
    with _Functions(), _Operations():
        yield GPU
