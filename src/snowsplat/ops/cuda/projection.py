"""`project` and the statistics of its splats on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.params import (
    ProjectBackwardParams,
    ProjectCullParams,
    ProjectForwardParams,
    ScreenStatisticsParams,
    SizeQueryParams,
)
from snowsplat.util.native_layout import POSE_SUMS, Params


@dataclass(slots=True, kw_only=True)
class PoseSumParams(Params):
    n: int
    sums: Tensor
    pose: Tensor


KERNELS: dict[str, Kernel] = {
    "project_cull": Kernel("project", ProjectCullParams, threads=256, items=256),
    "project_fwd": Kernel("project", ProjectForwardParams, threads=64, items=64),
    "project_bwd": Kernel("project", ProjectBackwardParams, threads=64, items=64),
    "project_pose_sum": Kernel("project", PoseSumParams, threads=512, items=512),
    "accumulate_screen_statistics": Kernel(
        "statistic", ScreenStatisticsParams, threads=256, items=256
    ),
}


def project_cull(run: Run, suffix: str, p: ProjectCullParams) -> int:
    """Returns the number of all rows; the id of a Gaussian that is not visible is −1."""
    run("project_cull" + suffix, KERNELS["project_cull"].blocks(p.n), p)
    return p.n


def project_pose_blocks(run: Run, suffix: str, query: SizeQueryParams) -> int:
    return min(query.n, 1)


def project_bwd(run: Run, suffix: str, p: ProjectBackwardParams) -> int:
    blocks = KERNELS["project_bwd"].blocks(p.n)
    if p.pose is None:
        run("project_bwd" + suffix, blocks, p)
        return 0
    sums = torch.empty(blocks, POSE_SUMS, dtype=torch.float64, device=p.ids.device)
    run("project_bwd" + suffix, blocks, replace(p, pose=sums))
    run("project_pose_sum", min(blocks, 1), PoseSumParams(n=blocks, sums=sums, pose=p.pose))
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "project_cull": project_cull,
    "project_pose_blocks": project_pose_blocks,
    "project_bwd": project_bwd,
}
