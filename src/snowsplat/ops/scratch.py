"""Reuses memory: `empty` returns tensors from a pool of blocks.

Every frame needs the same few large arrays. New memory from the operating system causes a page
fault every 4 kB; for the arrays of a sort, this takes longer than the sort itself. Therefore a
block of memory returns to the pool when its last tensor is deleted, and the next frame uses it.
Large blocks request huge pages.
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
_KEEP = 24  # maximum number of free blocks; the two passes of a frame need fewer
# Blocks begin at different offsets in a page. Otherwise the distance between a value and its
# moments could be a multiple of 4 kB, and loads would wait for stores to addresses with the same
# lower bits.
_STAGGER = 17 * 64

_free: list[np.ndarray] = []
_made = 0  # number of blocks created
_lock = threading.Lock()


class _BlockInUse(np.ndarray):
    """Memory of a block in use. The tensor refers to this array; its deletion frees the block."""

    block: np.ndarray | None = None

    def __array_finalize__(self, source: Any) -> None:
        self.block = None  # a view does not free the block

    def __del__(self) -> None:
        if self.block is None:
            return
        with _lock:
            _free.append(self.block)
            _free.sort(key=len)
            # The smallest blocks are removed first: they are the fastest to allocate again.
            del _free[: max(0, len(_free) - _KEEP)]


def empty(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """An uninitialised contiguous tensor on `device` (default: CPU), aligned to 64 bytes.

    On a GPU it is allocated by torch, whose own allocator reuses memory.
    """
    if device is not None and device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=device)
    size = _bytes(shape, dtype)
    if size < _PAGE:
        return torch.empty(shape, dtype=dtype)
    block = _take(size)
    array = block[:size].view(_BlockInUse)
    array.block = block
    return torch.from_numpy(array).view(dtype).view(shape)


def _bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    return math.prod(shape) * dtype.itemsize


def _take(size: int) -> np.ndarray:
    """The smallest free block of at least `size` bytes that is not several times too large."""
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

    Like the blocks of the pool, the memory has huge pages, and blocks begin at different offsets in
    a page. But it is not part of the pool: it is returned to the operating system, because the next
    size will be different.
    """
    if tensor.requires_grad or tensor.device.type != "cpu" or index.dtype == torch.bool:
        return tensor[index]
    shape = (len(index), *tensor.shape[1:])
    size = _bytes(shape, tensor.dtype)
    if size < _PAGE:
        return tensor[index]
    rows = torch.from_numpy(_make(size)[:size]).view(tensor.dtype).view(shape)
    return torch.index_select(tensor, 0, index, out=rows)
