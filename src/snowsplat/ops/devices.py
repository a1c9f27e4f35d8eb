"""Selects the device for the computation."""

import os
from collections.abc import Callable

import torch

from snowsplat.ops.cuda import availability
from snowsplat.ops.native import get_num_threads, isa
from snowsplat.util.errors import UserError
from snowsplat.util.machine import processor_name
from snowsplat.util.messages import Message, message


def default_device(note: Callable[[Message], None] | None = None) -> torch.device:
    """The GPU, or the CPU if there is no usable GPU.

    Args:
        note: called with a message if there is a GPU but it cannot be used.
    """
    index = _current_index()
    why = availability.why_unusable(index)
    if why is None:
        return torch.device("cuda", index)
    if note is not None and availability.has_gpu():
        note(message("the GPU cannot be used: {why}; computing on the CPU", why=why))
    return torch.device("cpu")


def resolve_device(
    text: str | None = None, note: Callable[[Message], None] | None = None
) -> torch.device:
    """The device that a user chose: "cpu", "cuda", "cuda:1" or "webgpu"; None: the best one.

    The best one is never webgpu: nowhere was it measured to be faster than the CPU. If `text` is
    None, the environment variable SNOWSPLAT_DEVICE is used.

    Args:
        note: called with a message if a GPU cannot be used and no device was requested.

    Raises:
        UserError: the device is unsupported, missing or cannot be used.
    """
    source, remedy = f"--device {text}", "leave --device out to use the CPU"
    if text is None:
        text = os.environ.get("SNOWSPLAT_DEVICE", "")
        if not text:
            return default_device(note)
        source, remedy = f"SNOWSPLAT_DEVICE={text}", "set it to cpu to use the CPU"
    if text == "webgpu":
        from snowsplat.ops.webgpu import adapter, backend

        why = adapter.why_unusable()
        if why is not None:
            raise UserError("{source}: {why}; {remedy}", source=source, why=why, remedy=remedy)
        return backend.enable()
    try:
        device = torch.device(text)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise UserError(
            "{source}: unsupported device; use cpu, cuda, cuda:1 or webgpu", source=source
        )
    if device.type == "cpu":
        return torch.device("cpu")
    index = _current_index() if device.index is None else device.index
    why = availability.why_unusable(index)
    if why is not None:
        raise UserError("{source}: {why}; {remedy}", source=source, why=why, remedy=remedy)
    return torch.device("cuda", index)


def device_name(device: torch.device) -> str:
    """A device in words: "NVIDIA H200 (cuda:0)", or the processor, its threads and instructions."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)} ({device})"
    if device.type == "webgpu":
        from snowsplat.ops.webgpu import adapter

        return f"{adapter.description()} ({device})"
    return f"{processor_name()}, {get_num_threads()} threads, {isa()}"


def _current_index() -> int:
    """The index of device "cuda": torch's current device, or 0 if the driver is not initialised."""
    return torch.cuda.current_device() if torch.cuda.is_initialized() else 0
