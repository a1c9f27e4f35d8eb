"""`project` and the statistics of its splats on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {
    "project_cull": Kernel("project", threads=256, items=256),
    "project_fwd": Kernel("project", threads=64, items=64),
    "project_bwd": Kernel("project", threads=64, items=64),
    "project_pose_sum": Kernel("project", threads=512, items=512),
    "accumulate_screen_statistics": Kernel("statistic", threads=256, items=256),
}


def project_cull(run: Run, suffix: str, n: int, *args: Any) -> int:
    """All rows stay: who is not seen has the id −1."""
    run("project_cull" + suffix, KERNELS["project_cull"].blocks(n), n, *args)
    return n


def project_pose_blocks(run: Run, suffix: str, m: int) -> int:
    return min(m, 1)


def project_bwd(run: Run, suffix: str, m: int, ids: Tensor, *args: Any) -> int:
    *rest, pose = args
    blocks = KERNELS["project_bwd"].blocks(m)
    sums = None
    if pose is not None:
        sums = torch.empty(blocks, 15, dtype=torch.float64, device=ids.device)
    run("project_bwd" + suffix, blocks, m, ids, *rest, sums)
    if sums is not None:
        run("project_pose_sum", min(blocks, 1), blocks, sums, pose)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "project_cull": project_cull,
    "project_pose_blocks": project_pose_blocks,
    "project_bwd": project_bwd,
}
