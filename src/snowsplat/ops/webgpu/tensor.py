"""`DeviceTensor`: a tensor on the device "webgpu", and how operations of torch act on it.

Views are computed from shapes and strides. A few operations that a training step needs have
kernels (`elementwise`). All others run on the CPU, on the copy of the memory there: they are right,
but slow for large tensors. `fallbacks` counts them.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._mode_utils import no_dispatch

from snowsplat.ops.webgpu.memory import Memory

DEVICE = "webgpu"
#: Operations that ran on the CPU although one of their tensors was only on the device: by name.
fallbacks: Counter[str] = Counter()
#: Kernels of operations of torch, by name. They return NotImplemented for arguments that they do
#: not support.
KERNELS: dict[str, Callable[..., Any]] = {}


class DeviceTensor(torch.Tensor):
    """A tensor on the device.

    Attributes:
        memory: its bytes, which views share.
        shape_only: a tensor without content (of torch's device "meta"), with the same shape,
            strides, offset and element type.
    """

    memory: Memory
    shape_only: Tensor

    @staticmethod
    def __new__(cls, memory: Memory, shape_only: Tensor) -> DeviceTensor:
        made: DeviceTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            shape_only.size(),
            strides=shape_only.stride(),
            storage_offset=shape_only.storage_offset(),
            dtype=shape_only.dtype,
            device=torch.device(DEVICE, 0),
        )
        made.memory, made.shape_only = memory, shape_only
        return made

    # The signatures in torch's stubs are narrower than what it calls.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return dispatch(func, args, kwargs or {})

    def tolist(self) -> Any:  # torch has none for subclasses
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        if not force:
            raise TypeError("a tensor on webgpu has no array of numpy; call cpu() before")
        return self.detach().cpu().numpy()

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"{self.detach().cpu()!r} on {self.device}"

    def __format__(self, spec: str) -> str:
        return format(self.detach().cpu(), spec)

    def on_host(self) -> Tensor:
        """The same elements on the CPU: a tensor that shares the memory."""
        elements = self.memory.host().view(self.dtype)
        return elements.as_strided(self.size(), self.stride(), self.storage_offset())

    @property
    def byte_range(self) -> tuple[int, int]:
        """The begin and the end of the elements of a contiguous tensor in its memory, in bytes."""
        begin = int(self.storage_offset()) * self.element_size()
        return begin, begin + self.numel() * self.element_size()


def empty(shape: Any, dtype: torch.dtype, strides: Any = None) -> DeviceTensor:
    """A tensor without content; ``strides``: by default those of a contiguous tensor."""
    shape_only = (
        torch.empty(shape, dtype=dtype, device="meta")
        if strides is None
        else torch.empty_strided(shape, strides, dtype=dtype, device="meta")
    )
    return DeviceTensor(Memory(shape_only.untyped_storage().nbytes()), shape_only)


def from_host(tensor: Tensor) -> DeviceTensor:
    """A tensor of the CPU as one of the device, which shares its memory."""
    storage = tensor.untyped_storage()
    size = storage.nbytes()
    if size % 8:  # the bytes are viewed as elements of any size
        storage = storage.clone()
        storage.resize_(-(-size // 8) * 8)
        tensor = torch.empty(0, dtype=tensor.dtype).set_(
            storage, tensor.storage_offset(), tensor.size(), tensor.stride()
        )
    host = torch.empty(0, dtype=torch.uint8).set_(storage)
    return DeviceTensor(Memory(size, host), _shape_only(tensor, size))


def _shape_only(tensor: Tensor, size: int) -> Tensor:
    elements = torch.empty(size // tensor.element_size(), dtype=tensor.dtype, device="meta")
    return elements.as_strided(tensor.size(), tensor.stride(), tensor.storage_offset())


class _Kind(NamedTuple):
    """What is needed of an operation: reading it from the schema takes longer than most of them.

    Attributes:
        name: such as "mul.Tensor".
        is_view: the result has the memory of the first argument.
        reshapes: it changes the shape of its argument, and not the content.
        written: position and name of the arguments that it changes.
    """

    name: str
    is_view: bool
    reshapes: bool
    written: tuple[tuple[int, str], ...]


@functools.cache
def _kind(func: Any) -> _Kind:
    arguments = enumerate(func._schema.arguments)
    return _Kind(
        str(func).removeprefix("aten."),
        func.is_view,
        torch.Tag.inplace_view in func.tags,
        tuple((i, x.name) for i, x in arguments if x.alias_info and x.alias_info.is_write),
    )


def dispatch(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Run an operation of torch, of which at least one argument is a tensor on the device."""
    kind = _kind(func)
    if kind.is_view:
        made = func(args[0].shape_only, *args[1:], **kwargs)
        if isinstance(made, Tensor):
            return DeviceTensor(args[0].memory, made)
        return [DeviceTensor(args[0].memory, view) for view in made]
    if kind.reshapes:
        with no_dispatch():
            func(*args, **kwargs)
        args[0].shape_only = func(args[0].shape_only, *args[1:], **kwargs)
        return args[0]
    kernel = KERNELS.get(kind.name)
    if kernel is not None:
        result = kernel(*args, **kwargs)
        if result is not NotImplemented:
            return result
    return on_cpu(func, args, kwargs)


class _Hosts:
    """Tensors on the CPU for the arguments of an operation, with the same memory."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.of: dict[int, Tensor] = {}  # by the id of the argument
        self.arguments: dict[int, Tensor] = {}  # by the id of the tensor on the CPU

    def replaced(self, value: Any) -> Any:
        """An argument for the operation on the CPU."""
        if isinstance(value, DeviceTensor):
            if id(value) not in self.of:
                if not value.memory.is_on_host:
                    fallbacks[self.name] += 1
                host = self.of[id(value)] = value.on_host()
                self.arguments[id(host)] = value
            return self.of[id(value)]
        if isinstance(value, Tensor):
            self.arguments[id(value)] = value
        elif isinstance(value, (list, tuple)):
            return [self.replaced(each) for each in value]
        elif isinstance(value, torch.device) and value.type == DEVICE:
            return torch.device("cpu")
        return value

    def wrapped(self, result: Any) -> Any:
        """A result of the operation as one on the device."""
        if isinstance(result, (list, tuple)):
            return type(result)(self.wrapped(each) for each in result)
        if not isinstance(result, Tensor):
            return result
        if id(result) in self.arguments:
            return self.arguments[id(result)]
        if result.numel():  # it may be a view that is not declared as one
            begin = result.untyped_storage().data_ptr()
            for argument in self.arguments.values():
                if isinstance(argument, DeviceTensor):
                    memory = argument.memory.host()
                    if memory.data_ptr() == begin:
                        return DeviceTensor(argument.memory, _shape_only(result, memory.numel()))
        return from_host(result)


def on_cpu(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Run an operation on the CPU, with tensors there that share the memory of the arguments."""
    kind = _kind(func)
    hosts = _Hosts(kind.name)
    given = [hosts.replaced(value) for value in args]
    made = func(*given, **{name: hosts.replaced(value) for name, value in kwargs.items()})
    for i, name in kind.written:
        changed = args[i] if i < len(args) else kwargs.get(name)
        for tensor in changed if isinstance(changed, (list, tuple)) else [changed]:
            if isinstance(tensor, DeviceTensor):
                if hosts.of[id(tensor)].shape != tensor.shape:
                    raise NotImplementedError(f"{func}: webgpu tensors cannot change their size")
                tensor.memory.changed_on_host()
    goes = kwargs.get("device")
    if goes is not None and torch.device(goes).type != DEVICE:
        return made
    return hosts.wrapped(made)
