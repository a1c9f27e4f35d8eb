"""Splats sorted into tiles, on a GPU.

The instances, pairs of a tile and a splat that touches it, are listed splat by splat in the order
of depth; the number of an instance in this list is its slot. A stable sort by tile then gives each
tile its splats, nearest first. Nothing waits for the GPU, unless the number of instances is asked.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.cuda.sorting import exclusive_scan, sort_pairs, sort_passes

KERNELS: dict[str, Kernel] = {
    "splats_prepare": Kernel("tiles", threads=256, items=256),
    "tiles_count": Kernel("tiles", threads=256, items=256),
    "tiles_fill": Kernel("tiles", threads=256, items=256),
    "tiles_start_u16": Kernel("tiles", threads=256, items=256),
    "tiles_start_u32": Kernel("tiles", threads=256, items=256),
    "tiles_gather": Kernel("tiles", threads=256, items=256),
    "splats_reduce": Kernel("tiles", threads=256, items=16),
}

_TILE = 16  # pixels
_HEAD = 16  # bytes of a workspace before its arrays: the number of instances
_ARRAYS = 4


def _nothing(run: Run, suffix: str, n: int, *args: object) -> int:
    return 0


def _workspace_bytes(run: Run, suffix: str, m: int, tiles: int, parts: int) -> int:
    return _HEAD + 4 * _ARRAYS * m


def _open_workspace(workspace: Tensor, m: int) -> tuple[Tensor, ...]:
    """What tiles_count leaves for tiles_fill.

    The number of instances (1,) int64, and of each splat, nearest first, the corner and the size of
    its rectangle of tiles, which of these it touches, and its first slot.
    """
    needed = workspace[: _HEAD // 2].view(torch.int64)
    return needed, *workspace[_HEAD:].view(torch.int32).view(_ARRAYS, m)


def _splats_prepare(
    run: Run,
    suffix: str,
    m: int,
    packed: Tensor,
    stride: int,
    width: float,
    height: float,
    columns: Tensor,
    records: Tensor,
    keys: Tensor,
) -> int:
    blocks = KERNELS["splats_prepare"].blocks(m)
    tiles = -(-int(width) // _TILE), -(-int(height) // _TILE)
    run(f"splats_prepare{suffix}", blocks, m, packed, stride, *tiles, keys)
    return 0


def _splats_sort(
    run: Run, suffix: str, m: int, keys: Tensor, keys2: Tensor, order: Tensor, order2: Tensor
) -> int:
    bits = 8 * keys.element_size()  # an even number of passes, so they end in `order`
    sort_pairs(run, m, keys, keys2, order, order2, (0, bits), rows=True)
    return 0


def _tiles_count(
    run: Run,
    suffix: str,
    m: int,
    order: Tensor,
    packed: Tensor,
    stride: int,
    records: Tensor,
    tiles_x: int,
    tiles_y: int,
    parts: int,
    workspace: Tensor,
    tile_start: Tensor,
    capacity: int,
    needed: Tensor,
) -> int:
    total, corners, sizes, tiles, slots = _open_workspace(workspace, m)
    blocks = KERNELS["tiles_count"].blocks(m)
    splats = (m, order, packed, stride, tiles_x, tiles_y)
    run(f"tiles_count{suffix}", blocks, *splats, corners, sizes, tiles, slots)
    exclusive_scan(run, m, slots, slots, total)
    needed.copy_(total)
    return int(needed.item()) if capacity < 0 else capacity


def _tiles_fill(
    run: Run,
    suffix: str,
    m: int,
    order: Tensor,
    packed: Tensor,
    stride: int,
    records: Tensor,
    tiles_x: int,
    tiles_y: int,
    parts: int,
    workspace: Tensor,
    tile_start: Tensor,
    capacity: int,
    instance_splat: Tensor,
    instance_slot: Tensor | None,
    slot_range: Tensor | None,
) -> int:
    needed, corners, sizes, touched, slots = _open_workspace(workspace, m)
    tiles = tiles_x * tiles_y  # and this is the tile of what is in none
    bits = tiles.bit_length()
    narrow = bits <= 16

    def empty(dtype: torch.dtype) -> Tensor:
        return torch.empty(capacity, dtype=dtype, device=packed.device)

    key = torch.int16 if narrow else torch.int32
    keys, keys2, spare = empty(key), empty(key), empty(torch.int32)
    # What the sort carries: the splats, or where slots are wanted these, and their splats follow.
    carried = instance_splat if instance_slot is None else instance_slot
    pair = (carried, spare) if sort_passes(bits) % 2 == 0 else (spare, carried)
    slot_splat = pair[0] if instance_slot is None else empty(torch.int32)
    run(
        f"tiles_fill{suffix}",
        KERNELS["tiles_fill"].blocks(m),
        *(m, order, packed, stride, tiles_x, tiles_y, corners, sizes, touched, slots),
        *((keys, None) if narrow else (None, keys)),
        slot_splat,
        capacity,
        slot_range,
    )
    rows = instance_slot is not None
    keys, _ = sort_pairs(run, capacity, keys, keys2, *pair, (0, bits), count=needed, rows=rows)
    if instance_slot is not None:
        blocks = KERNELS["tiles_gather"].blocks(capacity)
        run("tiles_gather", blocks, capacity, slot_splat, instance_slot, needed, instance_splat)
    start = "tiles_start_u16" if narrow else "tiles_start_u32"
    run(start, KERNELS[start].blocks(tiles + 1), tiles + 1, keys, needed, capacity, tile_start)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "splat_record_bytes": _nothing,  # blending reads the packed rows themselves
    "splats_recolor": _nothing,
    "tiles_parts": _nothing,
    "tiles_workspace_bytes": _workspace_bytes,
    "splats_prepare": _splats_prepare,
    "splats_sort": _splats_sort,
    "tiles_count": _tiles_count,
    "tiles_fill": _tiles_fill,
}
