"""Prefix sums and a stable radix sort on a GPU, for the other modules.

If the number of pairs is known only on the GPU, `sort_pairs` takes an upper bound and a tensor with
the actual number. These functions do not wait for the GPU.
"""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import KERNELS, Run

_DIGIT_BITS = 8
FEW = 1 << 19  # keys of at most 32 bits that are sorted with few keys per block
MOST_ADDED = 128  # blocks whose counts `sort_scatter` adds; for more, `sort_offsets` does it first
_KEYS = {torch.int16: "u16", torch.int32: "u32", torch.int64: "u64"}


def exclusive_scan(run: Run, n: int, values: Tensor, out: Tensor, total: Tensor) -> None:
    """out[i] = the sum of values[:i]; total, (1,) int64, is the sum of all n values.

    `values` and `out` are uint32 and may be the same tensor. A sum that does not fit becomes
    2^32 − 1; the total is exact.
    """
    blocks = KERNELS["scan_sums"].blocks(n)
    sums = torch.empty(blocks, dtype=torch.int64, device=values.device)
    scan = {"n": n, "values": values, "sums": sums, "out": out, "total": total}
    run("scan_sums", scan)
    run("scan_of_sums", {**scan, "n": blocks}, 1)
    run("scan_apply", scan)


def sort_passes(bits: int) -> int:
    """The number of passes of `sort_pairs` for keys with this many significant bits."""
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
    """A stable sort of unsigned keys of 16, 32 or 64 bits, with values of 32 bits.

    bits: begin and end of the significant bits of a key; at least one bit.
    count: (1,) int64, the number of pairs, at most n; the remaining pairs are ignored.
    rows: the values are the indices of the pairs, 0, 1, …; the content of `values` is ignored.

    Returns the sorted keys and values: keys and values if `sort_passes` is even, else keys2 and
    values2. The other two are overwritten.
    """
    name, device = _KEYS[keys.dtype], keys.device
    if n <= FEW and keys.dtype != torch.int64:
        name = f"few_{name}"
    blocks = KERNELS[f"sort_count_{name}"].blocks(n)
    counts = torch.empty(blocks << _DIGIT_BITS, dtype=torch.int32, device=device)
    totals = None
    if blocks > MOST_ADDED:
        totals = torch.empty(1 << _DIGIT_BITS, dtype=torch.int32, device=device)
    begin, end = bits
    passes = sort_passes(end - begin)
    for i in range(passes):
        shift = begin + (end - begin) * i // passes
        width = begin + (end - begin) * (i + 1) // passes - shift
        sort_pass = {
            "n": n,
            "keys": keys,
            "values": None if rows and i == 0 else values,
            "keys_out": keys2,
            "values_out": values2,
            "shift": shift,
            "bits": width,
            "blocks": blocks,
            "counts": counts,
            "totals": totals,
            "count": count,
        }
        run(f"sort_count_{name}", sort_pass)
        if totals is not None:
            run("sort_offsets", {"n": blocks, "counts": counts, "totals": totals}, 1 << width)
        run(f"sort_scatter_{name}", sort_pass)
        keys, keys2, values, values2 = keys2, keys, values2, values
    return keys, values
