"""The adapter (a GPU, or a driver that computes on the CPU) and the queue of its commands.

Commands are recorded, and submitted after each native function, so no command buffer takes long
enough for the watchdog of a system.
"""

from __future__ import annotations

import functools
import importlib
import threading
from typing import Any

from snowsplat.util.errors import UserError

#: Storage buffers of a kernel: what every browser has.
STORAGE_BUFFERS = 8
ALIGNMENT = 256  # of the begin of a binding in its buffer, bytes
_UNIFORMS = 1 << 18  # bytes, for the numbers of the kernels of a command buffer

_LIMITS = ("max-buffer-size", "max-storage-buffer-binding-size")


@functools.cache
def _found() -> Any:
    """The adapter, or the reason why there is none, as a text without a full stop."""
    try:
        wgpu = importlib.import_module("wgpu")
    except ImportError:
        return "the package wgpu is missing: pip install 'snowsplat[webgpu]'"
    try:
        return wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except Exception as error:  # wgpu raises RuntimeError, and errors of the drivers
        return f"wgpu finds no adapter ({str(error).splitlines()[0]}); install a driver for Vulkan"


def why_unusable() -> str | None:
    """The reason why the device cannot be used, and the remedy; None: it can be used.

    The text has no full stop at its end.
    """
    from snowsplat.ops.webgpu import backend

    found = _found()
    if isinstance(found, str):
        return found
    return backend.why_unsupported()


def inventory() -> dict[str, Any]:
    """For doctor: the adapter in words, or why the device cannot be used."""
    why = why_unusable()
    return {"adapter": None if why else _in_words(_found().info), "why_unused": why}


def description() -> str:
    """The adapter in words: "llvmpipe (LLVM 15.0.6, 256 bits), Vulkan, computes on the CPU"."""
    return _in_words(gpu().adapter)


def _in_words(found: Any) -> str:
    parts = [found["device"] or found["description"] or found["vendor"], found["backend_type"]]
    if found["adapter_type"] == "CPU":
        parts.append("computes on the CPU")
    return ", ".join(parts)


class Gpu:
    """The device of wgpu, and the commands that are not yet submitted.

    Attributes:
        lock: held while commands are recorded; threads of torch run backward passes.
        device: the device of wgpu.
        largest: bytes of a binding, at most.
    """

    def __init__(self) -> None:
        found = _found()
        if isinstance(found, str):
            raise UserError("webgpu: {why}", why=found)
        self.lock = threading.RLock()
        self.wgpu = importlib.import_module("wgpu")
        self.adapter = found.info
        limits = {key: found.limits[key] for key in _LIMITS}
        self.device = found.request_device_sync(required_limits=limits)
        self.largest = min(limits.values())
        usage = self.wgpu.BufferUsage
        self._usage = usage.STORAGE | usage.COPY_SRC | usage.COPY_DST
        self._uniforms = self.device.create_buffer(
            size=_UNIFORMS, usage=usage.UNIFORM | usage.COPY_DST
        )
        self._numbers = bytearray()
        self._encoder: Any = None

    def buffer(self, size: int) -> Any:
        """A new buffer of ``size`` bytes, a multiple of 4."""
        return self.device.create_buffer(size=size, usage=self._usage)

    def encoder(self) -> Any:
        """The recorder of commands. The lock must be held."""
        if self._encoder is None:
            self._encoder = self.device.create_command_encoder()
        return self._encoder

    def uniform(self, numbers: bytes) -> dict[str, Any]:
        """A binding with these numbers, for the next kernel. The lock must be held."""
        if len(self._numbers) + ALIGNMENT > _UNIFORMS:
            self.submit()
        offset, size = len(self._numbers), -(-len(numbers) // 16) * 16
        self._numbers += numbers.ljust(-(-size // ALIGNMENT) * ALIGNMENT, b"\0")
        return {"buffer": self._uniforms, "offset": offset, "size": size}

    def submit(self) -> None:
        """Submit the recorded commands."""
        with self.lock:
            if self._encoder is None:
                return
            recorded, numbers = self._encoder, self._numbers
            self._encoder, self._numbers = None, bytearray()
            if numbers:
                self.device.queue.write_buffer(self._uniforms, 0, numbers)
            self.device.queue.submit([recorded.finish()])

    def write(self, buffer: Any, offset: int, data: Any) -> None:
        """Copy ``data``, a multiple of 4 bytes, to a buffer, after the recorded commands."""
        with self.lock:
            self.submit()
            self.device.queue.write_buffer(buffer, offset, data)

    def read(self, buffer: Any, size: int) -> memoryview:
        """The first ``size`` bytes of a buffer, after all commands."""
        with self.lock:
            self.submit()
            return self.device.queue.read_buffer(buffer, 0, size)


@functools.cache
def gpu() -> Gpu:
    """The device of this process. Raises: UserError: there is none."""
    return Gpu()
