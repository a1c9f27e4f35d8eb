"""`Memory`: the content of a tensor and its views, on the device, on the CPU, or on both.

A native function works on the copy on the device, and an operation without a kernel on the copy on
the CPU. Each copy is brought up to date when it is used. So a chain of small operations on the CPU
needs one transfer, and none of them can see an old value.
"""

from __future__ import annotations

import sys
import threading
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.webgpu.adapter import gpu
from snowsplat.util.errors import UserError

_SMALLEST = 256  # bytes of a buffer
_KEPT = 64 << 20  # bytes of free buffers that are kept in any case


class _Pool:
    """Free buffers, by their size. Commands run in order, so a buffer can be reused at once.

    The buffers in use are here, too: a buffer that only its `Memory` refers to could be deleted
    together with it by Python, before `give` is called.
    """

    def __init__(self) -> None:
        self._free: dict[int, list[Any]] = defaultdict(list)
        self._in_use: dict[int, Any] = {}
        self._lock = threading.RLock()  # a tensor may be deleted while this thread has the lock
        self.used = self.free = 0  # bytes

    @staticmethod
    def rounded(size: int) -> int:
        """``size`` or up to a quarter more, so that similar sizes share buffers."""
        step = max(_SMALLEST, 1 << max(0, size.bit_length() - 3))
        return max(1, -(-size // step)) * step

    def take(self, size: int) -> Any:
        rounded = self.rounded(size)
        if rounded > gpu().largest >= size:
            rounded = -(-size // 4) * 4
        if rounded > gpu().largest:
            raise UserError(
                "webgpu: a tensor has {size} bytes, and this adapter allows {largest}; train with "
                "fewer Gaussians or smaller photos",
                size=size,
                largest=gpu().largest,
            )
        with self._lock:
            found = None
            if self._free[rounded]:
                self.free -= rounded
                found = self._free[rounded].pop()
            buffer = gpu().buffer(rounded) if found is None else found
            self.used += rounded
            self._in_use[id(buffer)] = buffer
            return buffer

    def give(self, buffer: Any) -> None:
        with self._lock:
            del self._in_use[id(buffer)]
            self.used -= buffer.size
            if self.free + buffer.size <= max(_KEPT, self.used):
                self.free += buffer.size
                self._free[buffer.size].append(buffer)
            # Otherwise its last reference is deleted here; wgpu frees it after its last command.


_pool = _Pool()


class Memory:
    """The bytes of a tensor. ``host``: those on the CPU, if they are known already, (size,) uint8.

    Attributes:
        size: in bytes.
    """

    def __init__(self, size: int, host: Tensor | None = None) -> None:
        self._buffer: Any = None
        self.size = size
        self._host = host
        # Which copies are up to date. New memory has no content, so both are.
        self._on_host, self._on_device = True, host is None

    def __del__(self, ends: Callable[[], bool] = sys.is_finalizing) -> None:
        if self._buffer is not None and not ends():  # at the end of Python, modules are empty
            _pool.give(self._buffer)

    def __deepcopy__(self, memo: Any) -> Memory:
        return Memory(self.size, self.host().clone())

    @property
    def is_on_device(self) -> bool:
        """Whether the copy on the device is up to date."""
        return self._on_device

    @property
    def is_on_host(self) -> bool:
        """Whether reading the values needs no transfer."""
        return self._on_host

    def host(self) -> Tensor:
        """The bytes on the CPU, up to date. After a change of them, call `changed_on_host`."""
        with gpu().lock:
            if self._host is None:
                self._host = torch.empty(-(-self.size // 8) * 8, dtype=torch.uint8)
            if not self._on_host:
                found = gpu().read(self._buffer, -(-self.size // 4) * 4)
                source = torch.frombuffer(found, dtype=torch.uint8)[: self.size]
                self._host[: self.size].copy_(source)
                self._on_host = True
            return self._host

    def changed_on_host(self) -> None:
        """The copy on the device is not up to date any more."""
        self._on_device = False

    def buffer(self) -> Any:
        """The buffer on the device, up to date. After a change of it, call `changed_on_device`."""
        with gpu().lock:
            if self._buffer is None:
                self._buffer = _pool.take(self.size)
            if not self._on_device:
                assert self._host is not None
                data = self._host[: self.size]
                if self.size % 4:
                    data = torch.cat([data, data.new_zeros(-self.size % 4)])
                if self.size:
                    gpu().write(self._buffer, 0, data.numpy())
                self._on_device = True
            return self._buffer

    def changed_on_device(self) -> None:
        """The copy on the CPU is not up to date any more."""
        self._on_host = False
        self._host = None
