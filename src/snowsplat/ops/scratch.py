"""Reuses memory: `empty` returns tensors from a pool of blocks.

Every frame needs the same few large arrays. New memory from the operating system causes a page
fault every 4 kB, which takes longer than the sorting that uses it. Therefore a block returns to the
pool when its last tensor is deleted, and the next frame uses it. Large blocks request huge pages.
"""

from __future__ import annotations

import math
import mmap
import threading
from typing import Any

import numpy as np
import torch
from torch import Tensor

_HUGE = 2 << 20  # bytes of a huge page
_PAGE = 4096
_KEEP = 24  # free blocks; more than a frame forward and backward needs
# Blocks begin at different offsets in a page. If a value and its moments were a multiple of 4 kB
# apart, loads would wait for stores whose addresses only have the same lower bits.
_STAGGER = 17 * 64

_free: list[np.ndarray] = []
_made = 0  # blocks so far
_lock = threading.Lock()


class _Loan(np.ndarray):
    """A block on loan to a tensor, which holds a reference to this; returns it when dropped."""

    block: np.ndarray | None = None

    def __array_finalize__(self, source: Any) -> None:
        self.block = None  # a view of a loan is not a loan itself

    def __del__(self) -> None:
        if self.block is None:
            return
        with _lock:
            _free.append(self.block)
            _free.sort(key=len)
            # The smallest are freed first: they are the cheapest to allocate again.
            del _free[: max(0, len(_free) - _KEEP)]


def empty(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """An uninitialised contiguous tensor on `device` (default: CPU), 64-byte aligned.

    On a GPU, torch's own allocator reuses memory.
    """
    if device is not None and device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=device)
    size = _bytes(shape, dtype)
    if size < _PAGE:
        return torch.empty(shape, dtype=dtype)
    block = _take(size)
    loan = block[:size].view(_Loan)
    loan.block = block
    return torch.from_numpy(loan).view(dtype).view(shape)


def _bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    return math.prod(shape) * dtype.itemsize


def _take(size: int) -> np.ndarray:
    """The smallest free block that holds `size` bytes and is not several times too large."""
    with _lock:
        for i, block in enumerate(_free):
            if size <= len(block) <= 4 * size + _HUGE:
                return _free.pop(i)
    # 25% more than requested, so that a growing scene does not need a new block every frame.
    return _make(size + size // 4)


def _make(size: int) -> np.ndarray:
    """A new block of at least `size` bytes."""
    global _made
    _made += 1
    unit = _PAGE if size < _HUGE else _HUGE
    pages = mmap.mmap(-1, -(-(size + _PAGE) // unit) * unit + unit)
    if unit == _HUGE and hasattr(mmap, "MADV_HUGEPAGE"):
        pages.madvise(mmap.MADV_HUGEPAGE)
    memory = np.frombuffer(pages, dtype=np.uint8)
    start = -memory.ctypes.data % unit + _made * _STAGGER % _PAGE
    return memory[start : len(memory) - _PAGE]


def take_rows(tensor: Tensor, index: Tensor) -> Tensor:
    """`tensor[index]` along the first dimension, for long-lived tensors: parameters, moments.

    The memory has huge pages and page offsets like the blocks of the pool, but does not belong to
    the pool: it returns to the operating system, since the next size will be different.
    """
    if tensor.requires_grad or tensor.device.type != "cpu" or index.dtype == torch.bool:
        return tensor[index]
    shape = (len(index), *tensor.shape[1:])
    size = _bytes(shape, tensor.dtype)
    if size < _PAGE:
        return tensor[index]
    rows = torch.from_numpy(_make(size)[:size]).view(tensor.dtype).view(shape)
    return torch.index_select(tensor, 0, index, out=rows)
