"""Sorting splats into tiles, on a GPU.

The instances (pairs of a splat and a tile that the splat touches) are listed in the order of the
depth of their splats; the index of an instance in this list is its slot. A stable sort by tile then
gives the splats of each tile, nearest first. The CPU does not wait for the GPU, unless the number
of instances is requested.

Prefix sums and a stable radix sort are also for the other modules. If the number of pairs is known
only on the GPU, `sort_pairs` takes an upper bound and a tensor with the actual number. These
functions do not wait for the GPU.
"""

from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import KERNELS, Run
from snowsplat.util.native_layout import Fields

_HEAD = 16  # bytes of a workspace before its arrays: the number of instances
_ARRAYS = ("corners", "sizes", "tiles", "slots")
_DIGIT_BITS = 8
FEW = 1 << 19  # keys of at most 32 bits that are sorted with few keys per block
MOST_ADDED = 128  # blocks whose counts `sort_scatter` adds; for more, `sort_offsets` does it first
_KEYS = {torch.int16: "u16", torch.int32: "u32", torch.int64: "u64"}


def workspace_bytes(run: Run, suffix: str, p: Fields) -> int:
    return _HEAD + 4 * len(_ARRAYS) * int(p["n"])


def _open_workspace(workspace: Tensor, n: int) -> tuple[Tensor, dict[str, Tensor]]:
    """The data that tiles_count passes to tiles_fill.

    These are the number of instances, (1,) int64, and for each splat, nearest first: the corner and
    the size of its rectangle of tiles, the touched tiles in the rectangle, and the first slot.
    """
    required = workspace[: _HEAD // 2].view(torch.int64)
    arrays = workspace[_HEAD:].view(torch.int32).view(len(_ARRAYS), n)
    return required, dict(zip(_ARRAYS, arrays, strict=True))


def _kernel_fields(p: Fields, arrays: dict[str, Tensor]) -> dict[str, Any]:
    """The fields that the kernels of `tiles_count` and `tiles_fill` have in common."""
    names = ("order", "packed", "stride", "tiles_x", "tiles_y")
    binning = {name: p[f"binning.{name}"] for name in names}
    return {"n": p["n"], **binning, **{name: arrays[name] for name in _ARRAYS[:3]}}


def splats_sort(run: Run, suffix: str, p: Fields) -> int:
    keys = p["keys"]
    bits = 8 * keys.element_size()  # an even number of passes, so that the result is in `order`
    sort_pairs(run, p["n"], keys, p["keys2"], p["order"], p["order2"], (0, bits), rows=True)
    return 0


def tiles_count(run: Run, suffix: str, p: Fields) -> int:
    n, capacity, required = p["n"], p["capacity"], p["required"]
    total, arrays = _open_workspace(p["binning.workspace"], n)
    slots = arrays["slots"]
    run(f"tiles_count{suffix}", {**_kernel_fields(p, arrays), "counts": slots})
    exclusive_scan(run, n, slots, slots, total)
    required.copy_(total)
    return int(required.item() if capacity < 0 else capacity)


def tiles_fill(run: Run, suffix: str, p: Fields) -> int:
    capacity, instance_splat, instance_slot = p["capacity"], p["instance_splat"], p["instance_slot"]
    required, arrays = _open_workspace(p["binning.workspace"], p["n"])
    # The number of tiles is also the key of instances without a tile.
    tiles = p["binning.tiles_x"] * p["binning.tiles_y"]
    bits = tiles.bit_length()
    narrow = bits <= 16

    def empty(dtype: torch.dtype) -> Tensor:
        return torch.empty(capacity, dtype=dtype, device=instance_splat.device)

    key = torch.int16 if narrow else torch.int32
    keys, keys2, spare = empty(key), empty(key), empty(torch.int32)
    # The values of the sort are the splats. If slots are required, the values are the slots, and
    # tiles_gather finds the splats afterwards.
    sorts_slots = instance_slot is not None
    sort_values = instance_slot if sorts_slots else instance_splat
    even = sort_passes(bits) % 2 == 0
    values, values2 = (sort_values, spare) if even else (spare, sort_values)
    slot_splat = empty(torch.int32) if sorts_slots else values
    run(
        f"tiles_fill{suffix}",
        {
            **_kernel_fields(p, arrays),
            "first_slots": arrays["slots"],
            "tiles_16": keys if narrow else None,
            "tiles_32": None if narrow else keys,
            "splats": slot_splat,
            "capacity": capacity,
            "slot_range": p["slot_range"],
        },
    )
    keys, _ = sort_pairs(
        run, capacity, keys, keys2, values, values2, (0, bits), count=required, rows=sorts_slots
    )
    if sorts_slots:
        gather = {"slot_splat": slot_splat, "instance_slot": instance_slot}
        gather |= {"required": required, "instance_splat": instance_splat}
        run("tiles_gather", {"n": capacity, **gather})
    starts = {"required": required, "capacity": capacity, "tile_start": p["binning.tile_start"]}
    name = "tiles_start_u16" if narrow else "tiles_start_u32"
    run(name, {"n": tiles + 1, "keys": keys, **starts})
    return 0


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
