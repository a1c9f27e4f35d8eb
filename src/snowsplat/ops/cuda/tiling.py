"""Sorting splats into tiles, on a GPU.

The instances (pairs of a splat and a tile that the splat touches) are listed in the order of the
depth of their splats; the index of an instance in this list is its slot. A stable sort by tile then
gives the splats of each tile, nearest first. The CPU does not wait for the GPU, unless the number
of instances is requested.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Run
from snowsplat.ops.cuda.sorting import exclusive_scan, sort_pairs, sort_passes
from snowsplat.util.native_layout import Fields

_HEAD = 16  # bytes of a workspace before its arrays: the number of instances
_ARRAYS = ("corners", "sizes", "tiles", "slots")


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
