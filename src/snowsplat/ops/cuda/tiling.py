"""Sorting splats into tiles, on a GPU.

The instances (pairs of a splat and a tile that the splat touches) are listed in the order of the
depth of their splats; the index of an instance in this list is its slot. A stable sort by tile then
gives the splats of each tile, nearest first. The CPU does not wait for the GPU, unless the number
of instances is requested.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.cuda.sorting import exclusive_scan, sort_pairs, sort_passes
from snowsplat.ops.params import (
    SizeQueryParams,
    SplatsPrepareParams,
    SplatsReduceParams,
    SplatsSortParams,
    TilesCountParams,
    TilesFillParams,
)
from snowsplat.util.native_layout import SLOT_WIDTH, Params


@dataclass(slots=True, kw_only=True)
class _RectangleParams(Params):
    n: int
    order: Tensor
    packed: Tensor
    stride: int
    tiles_x: int
    tiles_y: int
    corners: Tensor
    sizes: Tensor
    tiles: Tensor


@dataclass(slots=True, kw_only=True)
class TilesCountKernelParams(_RectangleParams):
    counts: Tensor


@dataclass(slots=True, kw_only=True)
class TilesFillKernelParams(_RectangleParams):
    first_slots: Tensor
    tiles_16: Tensor | None
    tiles_32: Tensor | None
    splats: Tensor
    capacity: int
    slot_range: Tensor | None


@dataclass(slots=True, kw_only=True)
class TilesStartParams(Params):
    n: int
    keys: Tensor
    required: Tensor
    capacity: int
    tile_start: Tensor


@dataclass(slots=True, kw_only=True)
class TilesGatherParams(Params):
    n: int
    slot_splat: Tensor
    instance_slot: Tensor
    required: Tensor
    instance_splat: Tensor


KERNELS: dict[str, Kernel] = {
    "splats_prepare": Kernel("tiles", SplatsPrepareParams, threads=256, items=256),
    "tiles_count": Kernel("tiles", TilesCountKernelParams, threads=256, items=256),
    "tiles_fill": Kernel("tiles", TilesFillKernelParams, threads=256, items=256),
    "tiles_start_u16": Kernel("tiles", TilesStartParams, threads=256, items=256),
    "tiles_start_u32": Kernel("tiles", TilesStartParams, threads=256, items=256),
    "tiles_gather": Kernel("tiles", TilesGatherParams, threads=256, items=256),
    "splats_reduce": Kernel("tiles", SplatsReduceParams, threads=256, items=256 // SLOT_WIDTH),
}

_HEAD = 16  # bytes of a workspace before its arrays: the number of instances
_ARRAYS = 4


def _zero(run: Run, suffix: str, params: Params) -> int:
    return 0


def _workspace_bytes(run: Run, suffix: str, query: SizeQueryParams) -> int:
    return _HEAD + 4 * _ARRAYS * query.n


def _open_workspace(workspace: Tensor, n: int) -> tuple[Tensor, ...]:
    """The data that tiles_count passes to tiles_fill.

    These are the number of instances, (1,) int64, and for each splat, nearest first: the corner and
    the size of its rectangle of tiles, the touched tiles in the rectangle, and the first slot.
    """
    required = workspace[: _HEAD // 2].view(torch.int64)
    return required, *workspace[_HEAD:].view(torch.int32).view(_ARRAYS, n)


def _splats_sort(run: Run, suffix: str, p: SplatsSortParams) -> int:
    bits = 8 * p.keys.element_size()  # an even number of passes, so that the result is in `order`
    sort_pairs(run, p.n, p.keys, p.keys2, p.order, p.order2, (0, bits), rows=True)
    return 0


def _tiles_count(run: Run, suffix: str, p: TilesCountParams) -> int:
    binning = p.binning
    total, corners, sizes, tiles, slots = _open_workspace(binning.workspace, p.n)
    run(
        f"tiles_count{suffix}",
        KERNELS["tiles_count"].blocks(p.n),
        TilesCountKernelParams(
            n=p.n,
            order=binning.order,
            packed=binning.packed,
            stride=binning.stride,
            tiles_x=binning.tiles_x,
            tiles_y=binning.tiles_y,
            corners=corners,
            sizes=sizes,
            tiles=tiles,
            counts=slots,
        ),
    )
    exclusive_scan(run, p.n, slots, slots, total)
    p.required.copy_(total)
    return int(p.required.item()) if p.capacity < 0 else p.capacity


def _tiles_fill(run: Run, suffix: str, p: TilesFillParams) -> int:
    binning, capacity = p.binning, p.capacity
    required, corners, sizes, touched, slots = _open_workspace(binning.workspace, p.n)
    tiles = binning.tiles_x * binning.tiles_y  # also the key of instances without a tile
    bits = tiles.bit_length()
    narrow = bits <= 16

    def empty(dtype: torch.dtype) -> Tensor:
        return torch.empty(capacity, dtype=dtype, device=binning.packed.device)

    key = torch.int16 if narrow else torch.int32
    keys, keys2, spare = empty(key), empty(key), empty(torch.int32)
    # The values of the sort are the splats. If slots are required, the values are the slots, and
    # tiles_gather finds the splats afterwards.
    sorts_slots = p.instance_slot is not None
    sort_values = p.instance_splat if p.instance_slot is None else p.instance_slot
    pair = (sort_values, spare) if sort_passes(bits) % 2 == 0 else (spare, sort_values)
    slot_splat = empty(torch.int32) if sorts_slots else pair[0]
    run(
        f"tiles_fill{suffix}",
        KERNELS["tiles_fill"].blocks(p.n),
        TilesFillKernelParams(
            n=p.n,
            order=binning.order,
            packed=binning.packed,
            stride=binning.stride,
            tiles_x=binning.tiles_x,
            tiles_y=binning.tiles_y,
            corners=corners,
            sizes=sizes,
            tiles=touched,
            first_slots=slots,
            tiles_16=keys if narrow else None,
            tiles_32=None if narrow else keys,
            splats=slot_splat,
            capacity=capacity,
            slot_range=p.slot_range,
        ),
    )
    keys, _ = sort_pairs(
        run, capacity, keys, keys2, *pair, (0, bits), count=required, rows=sorts_slots
    )
    if p.instance_slot is not None:
        run(
            "tiles_gather",
            KERNELS["tiles_gather"].blocks(capacity),
            TilesGatherParams(
                n=capacity,
                slot_splat=slot_splat,
                instance_slot=p.instance_slot,
                required=required,
                instance_splat=p.instance_splat,
            ),
        )
    start = "tiles_start_u16" if narrow else "tiles_start_u32"
    run(
        start,
        KERNELS[start].blocks(tiles + 1),
        TilesStartParams(
            n=tiles + 1,
            keys=keys,
            required=required,
            capacity=capacity,
            tile_start=binning.tile_start,
        ),
    )
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "splat_record_bytes": _zero,  # the GPU has no records: it reads the packed rows
    "splats_recolor": _zero,
    "tiles_parts": _zero,
    "tiles_workspace_bytes": _workspace_bytes,
    "splats_sort": _splats_sort,
    "tiles_count": _tiles_count,
    "tiles_fill": _tiles_fill,
}
