"""`adam_step` on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {
    "adam_splat_of": Kernel("adam", threads=256, items=256),
    "adam_update": Kernel("adam", threads=64, items=64),
}

_VIEW = 10  # arguments: the camera, and the rows and the degree of sh_rest
_TENSOR = 5  # arguments of each of the six parameters, its rate last


def adam_step(
    run: Run, suffix: str, n: int, m: int, ids: Tensor, grad_packed: Tensor, *args: Any
) -> int:
    view, tensors = args[:_VIEW], list(args[_VIEW : _VIEW + 6 * _TENSOR])
    step, beta1, beta2, eps, visible_only, valid, nonfinite_rows = args[_VIEW + 6 * _TENSOR :]
    rates = slice(_TENSOR - 1, None, _TENSOR)
    tensors[rates] = [rate / (1 - beta1**step) for rate in tensors[rates]]
    splat_of = ids  # of `project`: a row for each Gaussian, −1 where it is not seen
    if m != n:
        splat_of = torch.full((n,), -1, dtype=torch.int32, device=ids.device)
        run("adam_splat_of", KERNELS["adam_splat_of"].blocks(m), m, ids, n, splat_of)
    run(
        "adam_update" + suffix,
        KERNELS["adam_update"].blocks(n),
        n,
        splat_of,
        grad_packed,
        *view,
        *tensors,
        beta1,
        beta2,
        1 / (1 - beta2**step),
        eps * eps,
        visible_only,
        valid,
        nonfinite_rows,
    )
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {"adam_step": adam_step}
