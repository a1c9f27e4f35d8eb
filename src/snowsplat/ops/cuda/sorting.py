"""Prefix sums and a stable radix sort on a GPU, which the other parts are made with.

Lengths may be known on the GPU only: `sort_pairs` takes the most that there can be and a tensor
with how many there are. Nothing here waits for the GPU.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {
    "scan_sums": Kernel("sort", threads=256, items=1024),
    "scan_of_sums": Kernel("sort", threads=256, items=256),
    "scan_apply": Kernel("sort", threads=256, items=1024),
    "sort_offsets": Kernel("sort", threads=256, items=1024),
    "sort_count_u16": Kernel("sort", threads=256, items=4096),
    "sort_count_u32": Kernel("sort", threads=256, items=4096),
    "sort_count_u64": Kernel("sort", threads=256, items=2048),
    "sort_scatter_u16": Kernel("sort", threads=256, items=4096),
    "sort_scatter_u32": Kernel("sort", threads=256, items=4096),
    "sort_scatter_u64": Kernel("sort", threads=256, items=2048),
}

SEQUENCES: dict[str, Callable[..., int]] = {}

_DIGIT_BITS = 8
_KEYS = {torch.int16: "u16", torch.int32: "u32", torch.int64: "u64"}


def exclusive_scan(run: Run, n: int, values: Tensor, out: Tensor, total: Tensor) -> None:
    """out[i] = the sum of values[:i], both uint32; may be the same. total (1,) int64: of all n.

    Sums that do not fit become 2^32 − 1; the total is exact.
    """
    blocks = KERNELS["scan_sums"].blocks(n)
    sums = torch.empty(blocks, dtype=torch.int64, device=values.device)
    run("scan_sums", blocks, n, values, sums)
    run("scan_of_sums", 1, blocks, sums, total)
    run("scan_apply", blocks, n, values, sums, out)


def sort_passes(bits: int) -> int:
    """Through how many passes `sort_pairs` takes keys of so many bits."""
    return -(-bits // _DIGIT_BITS)


def sort_pairs(
    run: Run,
    n: int,
    keys: Tensor,
    keys2: Tensor,
    values: Tensor,
    values2: Tensor,
    bits: tuple[int, int],
    *,
    count: Tensor | None = None,
    rows: bool = False,
) -> tuple[Tensor, Tensor]:
    """Sorts keys, unsigned of 16, 32 or 64 bits, with their values of 32; equal keys keep order.

    bits: begin and end of the bits of a key that count; there is at least one.
    count: (1,) int64, how many of the n pairs there are; those behind are left out.
    rows: the values are the pairs' numbers 0, 1, …; what is in `values` does not matter then.

    Gives the sorted keys and values: keys and values where `sort_passes` is even, else keys2 and
    values2. The other two are overwritten.
    """
    name, device = _KEYS[keys.dtype], keys.device
    blocks = KERNELS[f"sort_count_{name}"].blocks(n)
    counts = torch.empty(blocks << _DIGIT_BITS, dtype=torch.int32, device=device)
    totals = counts  # those of a single block are
    if blocks > 1:
        totals = torch.empty(1 << _DIGIT_BITS, dtype=torch.int32, device=device)
    begin, end = bits
    passes = sort_passes(end - begin)
    for i in range(passes):
        shift = begin + (end - begin) * i // passes
        width = begin + (end - begin) * (i + 1) // passes - shift
        run(f"sort_count_{name}", blocks, n, keys, shift, width, blocks, counts, count)
        if blocks > 1:
            run("sort_offsets", 1 << width, blocks, counts, totals)
        given = None if rows and i == 0 else values
        pairs = (keys, given, keys2, values2)
        run(f"sort_scatter_{name}", blocks, n, *pairs, shift, width, blocks, counts, totals, count)
        keys, keys2, values, values2 = keys2, keys, values2, values
    return keys, values
