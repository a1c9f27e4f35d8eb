"""`DeviceTensor`: a tensor on the device "webgpu", and how operations of torch act on it.

Views are computed from shapes and strides. A few operations that a training step needs have
kernels (`elementwise`). All others run on the CPU, on the copy of the memory there: they are right,
but slow for large tensors. `fallbacks` counts them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

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


def dispatch(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Run an operation of torch, of which at least one argument is a tensor on the device."""
    name = func._schema.name.removeprefix("aten::")
    if func.is_view:
        made = func(_shapes(args[0]), *args[1:], **kwargs)
        return pytree.tree_map(lambda view: DeviceTensor(args[0].memory, view), made)
    kernel = KERNELS.get(name)
    if kernel is not None:
        result = kernel(*args, **kwargs)
        if result is not NotImplemented:
            return result
    return on_cpu(func, args, kwargs)


def _shapes(tensor: Any) -> Any:
    return tensor.shape_only if isinstance(tensor, DeviceTensor) else tensor


def on_cpu(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Run an operation on the CPU, with tensors there that share the memory of the arguments."""
    leaves, structure = pytree.tree_flatten((args, kwargs))
    device = torch.device("cpu")
    hosts: dict[int, Tensor] = {}
    for leaf in leaves:
        if isinstance(leaf, DeviceTensor):
            if not leaf.memory.is_on_host:
                fallbacks[func._schema.name] += 1
            hosts[id(leaf)] = leaf.on_host()
    given = [
        hosts[id(leaf)]
        if isinstance(leaf, DeviceTensor)
        else device
        if isinstance(leaf, torch.device) and leaf.type == DEVICE
        else leaf
        for leaf in leaves
    ]
    host_args, host_kwargs = pytree.tree_unflatten(given, structure)
    made = func(*host_args, **host_kwargs)
    _mark_changes(func, args, kwargs, hosts)
    goes = kwargs.get("device")
    if goes is not None and torch.device(goes).type != DEVICE:
        return made
    by_host = {id(host): leaf for leaf in leaves if (host := hosts.get(id(leaf))) is not None}
    by_memory = {host.untyped_storage().data_ptr(): by_host[id(host)] for host in hosts.values()}
    plain = {id(leaf) for leaf in leaves if isinstance(leaf, Tensor)}

    def wrapped(result: Any) -> Any:
        if not isinstance(result, Tensor) or id(result) in plain:
            return result
        if id(result) in by_host:
            return by_host[id(result)]
        shared = by_memory.get(result.untyped_storage().data_ptr()) if result.numel() else None
        if shared is not None:  # a view that is not declared as one
            size = shared.memory.host().numel()
            return DeviceTensor(shared.memory, _shape_only(result, size))
        return from_host(result)

    return pytree.tree_map(wrapped, made)


def _mark_changes(
    func: Any, args: tuple[Any, ...], kwargs: dict[str, Any], hosts: dict[int, Tensor]
) -> None:
    """After an operation on the CPU: the device does not have what it has written."""
    for i, argument in enumerate(func._schema.arguments):
        if argument.alias_info is None or not argument.alias_info.is_write:
            continue
        value = kwargs.get(argument.name, args[i] if i < len(args) else None)
        for tensor in pytree.tree_leaves(value):
            if isinstance(tensor, DeviceTensor):
                if hosts[id(tensor)].shape != tensor.shape:
                    raise NotImplementedError(f"{func}: webgpu tensors cannot change their size")
                tensor.memory.changed_on_host()
