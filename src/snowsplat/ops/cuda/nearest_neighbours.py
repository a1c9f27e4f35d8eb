"""`neighbours` on a GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import NEIGHBOUR_LISTS, Run
from snowsplat.ops.cuda.sorting import sort_pairs
from snowsplat.util.native_layout import Fields

_CHUNK = 32  # points of a chunk; also chunks of a group
_CODE_BITS = 63


def neighbours(run: Run, suffix: str, p: Fields) -> int:
    n, points = p["n"], p["points"]
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
        {"n": n, "points": points, "low": low, "high": high, "codes": codes},
    )
    others = torch.empty_like(codes), torch.empty_like(order)
    _, order = sort_pairs(run, n, codes, others[0], order, others[1], (0, _CODE_BITS), rows=True)
    run(
        "neighbours_chunks" + suffix,
        {"n": n, "points": points, "order": order, "ordered": ordered, "boxes": chunk_boxes},
    )
    run(
        "neighbours_groups" + suffix,
        {"n": chunks, "chunk_boxes": chunk_boxes, "boxes": group_boxes},
    )
    search = f"neighbours_of_{next(size for size in NEIGHBOUR_LISTS if size >= p['k'])}"
    boxes = {"chunk_boxes": chunk_boxes, "group_boxes": group_boxes}
    run(search + suffix, {**p, "points": ordered, "order": order, **boxes})
    return 0
