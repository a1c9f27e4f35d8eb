"""Reuses memory: `empty` returns tensors from a pool.

Every frame needs the same few large arrays. New memory from the operating system causes a page
fault every 4 kB; for the arrays of a sort, this takes longer than the sort itself. Therefore the
memory of a tensor returns to the pool when its last reference is deleted, and the next tensors use
it. The pool is one segment of memory, which is divided as required: free parts that are adjacent
become one. So it takes little more than the tensors that exist at the same time. If it is too
small, a larger one replaces it. Segments request huge pages.
"""

import math
import mmap
import operator
import threading
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

_HUGE = 2 << 20  # bytes of a huge page
_PAGE = 4096
_SMALLEST = 256 << 20  # bytes of a segment; the system gives memory for those that are written
_LINE = 64  # bytes; tensors begin at multiples of it
# Tensors begin at different offsets in a page. Otherwise the distance between a value and its
# moments could be a multiple of 4 kB, and loads would wait for stores to addresses with the same
# lower bits.
_STAGGER = 17 * _LINE


class _Segment:
    """Contiguous memory. ``holes`` are its free parts, each with its begin and end, ascending."""

    def __init__(self, size: int) -> None:
        self.memory = _make(size)
        self.holes = [(0, len(self.memory))]

    def take(self, length: int) -> int | None:
        """The begin of a new part, in the smallest hole that suffices; None if there is none."""
        suitable = [hole for hole in self.holes if hole[1] - hole[0] >= length]
        if not suitable:
            return None
        begin, end = hole = min(suitable, key=lambda hole: hole[1] - hole[0])
        rest = [(begin + length, end)] if begin + length < end else []
        position = self.holes.index(hole)
        self.holes[position : position + 1] = rest
        return begin

    def give(self, begin: int, end: int) -> None:
        """Free a part."""
        holes: list[tuple[int, int]] = []
        for low, high in sorted([*self.holes, (begin, end)]):
            if holes and holes[-1][1] == low:
                low = holes.pop()[0]
            holes.append((low, high))
        self.holes = holes


_pool: _Segment | None = None
# Parts to be freed. A tensor may be deleted at any time, also while this thread has the lock.
_returned: deque[tuple[_Segment, int, int]] = deque()
_made = 0  # number of calls of `_make`
_lock = threading.Lock()


class _InUse(np.ndarray):
    """Memory in use. The tensor refers to this array; its deletion frees the memory."""

    part: tuple[_Segment, int, int] | None = None

    def __array_finalize__(self, source: Any) -> None:
        self.part = None  # a view does not free the memory

    def __del__(self) -> None:
        if self.part is not None and self.part[0] is _pool:
            _returned.append(self.part)


def empty(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """An uninitialised contiguous tensor on `device` (default: CPU), aligned to 64 bytes.

    On a GPU it is allocated by torch, whose own allocator reuses memory.
    """
    if device is not None and device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=device)
    size = _bytes(shape, dtype)
    if size < _PAGE:
        return torch.empty(shape, dtype=dtype)
    segment, begin, _ = part = _take(size)
    array = segment.memory[begin : begin + size].view(_InUse)
    array.part = part
    return torch.from_numpy(array).view(dtype).view(shape)


def empty_like(tensor: Tensor) -> Tensor:
    """`empty` with the shape, dtype and device of a tensor, which need not be contiguous."""
    return empty(tuple(tensor.shape), tensor.dtype, tensor.device)


def _bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    return operator.index(math.prod(shape)) * dtype.itemsize  # TypeError before the pool changes


def _take(size: int) -> tuple[_Segment, int, int]:
    """A part of at least `size` bytes: its segment, begin and end."""
    global _pool
    length = -(-size // _LINE) * _LINE + _STAGGER
    with _lock:
        while _returned:
            segment, begin, end = _returned.popleft()
            segment.give(begin, end)
        found = None if _pool is None else _pool.take(length)
        if _pool is None or found is None:
            # The system gets the memory of the old segment back when its last tensor is deleted.
            old = 0 if _pool is None else len(_pool.memory)
            _pool = _Segment(max(2 * old, old + 2 * length, _SMALLEST))
            found = _pool.take(length)
        assert found is not None
        return _pool, found, found + length


def _make(size: int) -> np.ndarray:
    """New memory of at least `size` bytes."""
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

    Like the pool, the memory has huge pages, and tensors begin at different offsets in a page. But
    it is not part of the pool: it is returned to the operating system, because the next size will
    be different.
    """
    if tensor.requires_grad or tensor.device.type != "cpu" or index.dtype == torch.bool:
        return tensor[index]
    shape = (len(index), *tensor.shape[1:])
    size = _bytes(shape, tensor.dtype)
    if size < _PAGE:
        return tensor[index]
    rows = torch.from_numpy(_make(size)[:size]).view(tensor.dtype).view(shape)
    return torch.index_select(tensor, 0, index, out=rows)
