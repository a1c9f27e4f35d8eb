"""Makes the device "webgpu" known to torch, once in a process."""

from __future__ import annotations

import functools
import threading
from typing import Any

import torch

from snowsplat.ops.webgpu import elementwise  # noqa: F401 -- registers kernels
from snowsplat.ops.webgpu import tensor as tensors
from snowsplat.util.errors import UserError

_OLDEST = "2.10"  # of the versions of torch with devices that are written in Python
_lock = threading.Lock()
#: Operations that create a tensor in a way that the general fallback cannot follow.
_SIZED = ("arange", "arange.start", "arange.start_step", "linspace", "randperm", "eye", "eye.m")


def _setup() -> Any:
    from torch.utils import backend_registration

    return getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)


def why_unsupported() -> str | None:
    """The reason why this torch cannot have the device; None: it can."""
    if _setup() is None:
        return f"it needs PyTorch {_OLDEST} or newer, and this is {torch.__version__}"
    return None


def enable() -> torch.device:
    """Make the device known to torch, if it is not yet, and return it.

    Raises:
        UserError: this torch cannot have it, another package has registered a device, or torch has
            computed gradients before.
    """
    with _lock:
        device = _registered()
        _check_gradients(device)
        return device


@functools.cache
def _registered() -> torch.device:
    why = why_unsupported()
    if why is not None:
        raise UserError("webgpu: {why}", why=why)
    try:
        _setup()(tensors.DEVICE)
    except RuntimeError as error:
        raise UserError("webgpu: {why}", why=str(error).splitlines()[0]) from None
    aten, every = torch.library.Library("aten", "IMPL"), torch.library.Library("_", "IMPL")
    key = "PrivateUse1"
    every.fallback(lambda func, *args, **kwargs: tensors.dispatch(func, args, kwargs), key)
    aten.impl("empty.memory_format", _empty, key)
    aten.impl("empty_strided", _empty_strided, key)
    aten.impl("copy_", _copy, key)
    for name in _SIZED:
        packet, _, overload = name.partition(".")
        func = getattr(getattr(torch.ops.aten, packet), overload or "default")
        aten.impl(name, functools.partial(_on_cpu, func), key)
    _libraries.extend((aten, every))
    return torch.device(tensors.DEVICE, 0)


def _check_gradients(device: torch.device) -> None:
    """Torch has a queue of gradients for each device that it knows at the first backward pass.

    Raises: UserError: that was before the device was known.
    """
    one = torch.zeros(1, device=device).requires_grad_()
    try:
        with torch.enable_grad():
            one.view(1).backward()
    except RuntimeError:
        raise UserError(
            "webgpu: torch has computed gradients before it knew the device; start a new process, "
            'and call snowsplat.ops.resolve_device("webgpu") first'
        ) from None


#: Registrations end when these objects are deleted.
_libraries: list[Any] = []


def _empty(size: Any, *, dtype: torch.dtype | None = None, **_: Any) -> Any:
    return tensors.empty(size, dtype or torch.get_default_dtype())


def _empty_strided(size: Any, stride: Any, *, dtype: torch.dtype | None = None, **_: Any) -> Any:
    return tensors.empty(size, dtype or torch.get_default_dtype(), stride)


def _copy(target: Any, source: Any, non_blocking: bool = False) -> Any:
    return tensors.dispatch(torch.ops.aten.copy_.default, (target, source, non_blocking), {})


def _on_cpu(func: Any, *args: Any, **kwargs: Any) -> Any:
    kwargs.pop("pin_memory", None)
    return tensors.on_cpu(func, args, kwargs)
