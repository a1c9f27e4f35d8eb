"""`accumulate_screen_gradients`: how hard each Gaussian is pulled about on the screen."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import launch


@torch.no_grad()
def accumulate_screen_gradients(
    ids: Tensor, packed_grad: Tensor, width: int, height: int, norm_sum: Tensor, views: Tensor
) -> None:
    """Adds one view to the densification statistic of the Gaussians it sees, in place.

    norm_sum (N,) += |∂L/∂mean2d · (width/2, height/2)| and views (N,) += 1 at the rows `ids` (M,)
    int32, distinct, of `packed_grad` (M, columns), the gradient of `Splats2D.packed`. The factor
    states the gradient for a screen that spans [-1, 1], as the paper's threshold is (section 5.2).

    Raises ValueError where shapes or dtypes do not fit.
    """
    op = "accumulate_screen_gradients"
    check_float(op, "packed_grad", packed_grad)
    check_size(op, width, height)
    check_tensor(op, "packed_grad", packed_grad, (len(ids), None), packed_grad)
    check_tensor(op, "norm_sum", norm_sum, (None,), packed_grad)
    check_tensor(op, "views", views, (len(norm_sum),), packed_grad)
    if ids.dtype != torch.int32:
        raise ValueError(f"{op}: ids must be torch.int32, got {ids.dtype}")
    grad = packed_grad.contiguous()
    launch(
        variant(op, grad),
        len(ids),
        ids,
        grad,
        grad.shape[1],
        float(width),
        float(height),
        norm_sum,
        views,
    )
