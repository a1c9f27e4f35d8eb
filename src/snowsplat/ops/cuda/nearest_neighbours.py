"""neighbours on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.cuda.sorting import sort_pairs

_CHUNK = 32  # points of a chunk, chunks of a group
_CODE_BITS = 63
_LISTS = (1, 3, 8, 64)  # how many neighbours the searches keep

KERNELS: dict[str, Kernel] = {
    "neighbours_codes": Kernel("neighbours", threads=128, items=128),
    "neighbours_chunks": Kernel("neighbours", threads=128, items=128),
    "neighbours_groups": Kernel("neighbours", threads=128, items=128),
    **{f"neighbours_of_{k}": Kernel("neighbours", threads=128, items=128) for k in _LISTS},
}


def neighbours(run: Run, suffix: str, n: int, points: Tensor, k: int, distances: Tensor) -> int:
    if n == 0:
        return 0

    def run_for(name: str, count: int, *args: Tensor | int) -> None:
        run(name + suffix, KERNELS[name].blocks(count), count, *args)

    def empty(*shape: int, dtype: torch.dtype = points.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=points.device)

    low, high = torch.aminmax(points, dim=0)
    codes, order = empty(n, dtype=torch.int64), empty(n, dtype=torch.int32)
    run_for("neighbours_codes", n, points, low, high, codes)
    others = torch.empty_like(codes), torch.empty_like(order)
    _, order = sort_pairs(run, n, codes, others[0], order, others[1], (0, _CODE_BITS), rows=True)
    chunks = -(-n // _CHUNK)
    groups = -(-chunks // _CHUNK)
    ordered, chunk_boxes, group_boxes = empty(n, 3), empty(chunks, 8), empty(groups, 8)
    run_for("neighbours_chunks", n, points, order, ordered, chunk_boxes)
    run_for("neighbours_groups", chunks, chunk_boxes, group_boxes)
    most = next(most for most in _LISTS if most >= k)
    run_for(f"neighbours_of_{most}", n, ordered, order, chunk_boxes, group_boxes, k, distances)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {"neighbours": neighbours}
