"""`neighbours` on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.cuda.sorting import sort_pairs
from snowsplat.ops.params import NeighboursParams
from snowsplat.util.native_layout import MAX_NEIGHBOURS, Params

_CHUNK = 32  # points of a chunk; also chunks of a group
_CODE_BITS = 63
_LISTS = (1, 3, 8, MAX_NEIGHBOURS)  # numbers of neighbours for which there is a search kernel


@dataclass(slots=True, kw_only=True)
class NeighboursCodesParams(Params):
    n: int
    points: Tensor
    low: Tensor
    high: Tensor
    codes: Tensor


@dataclass(slots=True, kw_only=True)
class NeighboursChunksParams(Params):
    n: int
    points: Tensor
    order: Tensor
    ordered: Tensor
    boxes: Tensor


@dataclass(slots=True, kw_only=True)
class NeighboursGroupsParams(Params):
    n: int
    chunk_boxes: Tensor
    boxes: Tensor


@dataclass(slots=True, kw_only=True)
class NeighboursSearchParams(Params):
    n: int
    points: Tensor
    order: Tensor
    chunk_boxes: Tensor
    group_boxes: Tensor
    k: int
    distances: Tensor


KERNELS: dict[str, Kernel] = {
    name: Kernel("neighbours", params, threads=128, items=128)
    for name, params in (
        ("neighbours_codes", NeighboursCodesParams),
        ("neighbours_chunks", NeighboursChunksParams),
        ("neighbours_groups", NeighboursGroupsParams),
        *((f"neighbours_of_{k}", NeighboursSearchParams) for k in _LISTS),
    )
}


def neighbours(run: Run, suffix: str, p: NeighboursParams) -> int:
    n, points = p.n, p.points
    if n == 0:
        return 0

    def empty(*shape: int, dtype: torch.dtype = points.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=points.device)

    low, high = torch.aminmax(points, dim=0)
    codes, order = empty(n, dtype=torch.int64), empty(n, dtype=torch.int32)
    chunks = -(-n // _CHUNK)
    groups = -(-chunks // _CHUNK)
    ordered, chunk_boxes, group_boxes = empty(n, 3), empty(chunks, 8), empty(groups, 8)
    run(
        "neighbours_codes" + suffix,
        KERNELS["neighbours_codes"].blocks(n),
        NeighboursCodesParams(n=n, points=points, low=low, high=high, codes=codes),
    )
    others = torch.empty_like(codes), torch.empty_like(order)
    _, order = sort_pairs(run, n, codes, others[0], order, others[1], (0, _CODE_BITS), rows=True)
    run(
        "neighbours_chunks" + suffix,
        KERNELS["neighbours_chunks"].blocks(n),
        NeighboursChunksParams(n=n, points=points, order=order, ordered=ordered, boxes=chunk_boxes),
    )
    run(
        "neighbours_groups" + suffix,
        KERNELS["neighbours_groups"].blocks(chunks),
        NeighboursGroupsParams(n=chunks, chunk_boxes=chunk_boxes, boxes=group_boxes),
    )
    search = f"neighbours_of_{next(size for size in _LISTS if size >= p.k)}"
    run(
        search + suffix,
        KERNELS[search].blocks(n),
        NeighboursSearchParams(
            n=n,
            points=ordered,
            order=order,
            chunk_boxes=chunk_boxes,
            group_boxes=group_boxes,
            k=p.k,
            distances=p.distances,
        ),
    )
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {"neighbours": neighbours}
