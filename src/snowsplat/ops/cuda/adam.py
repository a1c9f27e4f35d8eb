"""`adam_step` on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.params import AdamStepParams
from snowsplat.util.native_layout import Params


@dataclass(slots=True, kw_only=True)
class AdamSplatOfParams(Params):
    n: int
    ids: Tensor
    gaussians: int
    splat_of: Tensor


KERNELS: dict[str, Kernel] = {
    "adam_splat_of": Kernel("adam", AdamSplatOfParams, threads=256, items=256),
    "adam_update": Kernel("adam", AdamStepParams, threads=64, items=64),
}


def adam_step(run: Run, suffix: str, p: AdamStepParams) -> int:
    # If `project` returned all rows, the ids have a row for each Gaussian: −1 if it is not visible.
    splat_of = p.ids
    if p.splats != p.n:
        splat_of = torch.full((p.n,), -1, dtype=torch.int32, device=p.ids.device)
        run(
            "adam_splat_of",
            KERNELS["adam_splat_of"].blocks(p.splats),
            AdamSplatOfParams(n=p.splats, ids=p.ids, gaussians=p.n, splat_of=splat_of),
        )
    run("adam_update" + suffix, KERNELS["adam_update"].blocks(p.n), replace(p, ids=splat_of))
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {"adam_step": adam_step}
