"""Scratch memory that is used again.

A frame needs the same few large arrays every time. Fresh memory from the operating system costs a
page fault every 4 kB, at 1080p more than the sorting it is for, so blocks are kept and handed out
again as soon as nothing refers to the lease they went out with.
"""

from __future__ import annotations

import threading

import torch
from torch import Tensor

_free: list[Tensor] = []
_lock = threading.Lock()
_KEEP = 16  # free blocks; more than one frame in flight needs at once


class Lease:
    """A set of scratch tensors; they go back to the pool when the lease is dropped."""

    def __init__(self) -> None:
        self._blocks: list[Tensor] = []

    def empty(self, count: int, dtype: torch.dtype) -> Tensor:
        """An uninitialised 1-D tensor of `count` elements, 64-byte aligned."""
        size = count * dtype.itemsize
        block = _take(size)
        self._blocks.append(block)
        return block[:size].view(dtype)

    def __del__(self) -> None:
        with _lock:
            _free.extend(self._blocks)
            _free.sort(key=len)
            # The smallest go first: they are the cheapest to make again.
            del _free[: max(0, len(_free) - _KEEP)]


def _take(size: int) -> Tensor:
    """The smallest free block that holds `size` bytes and is not several times too large."""
    with _lock:
        for i, block in enumerate(_free):
            if size <= len(block) <= 4 * size + 4096:
                return _free.pop(i)
    # A quarter more than asked for, so that a growing scene does not need a new block every frame.
    return torch.empty(size + size // 4 + 4096, dtype=torch.uint8)
