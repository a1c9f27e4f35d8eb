"""`accumulate_screen_statistics`: the statistics of splats that density control uses."""

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.splats import Splats2D


@torch.no_grad()
def accumulate_screen_statistics(
    splats: Splats2D,
    width: int,
    height: int,
    norm_sum: Tensor,
    views: Tensor,
    max_radii: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    absolute: bool = False,
) -> None:
    """Adds one view to the statistics of the visible ones of N Gaussians, in place.

    The gradient ∂L/∂mean2d is that of `splats.packed.grad` or, if `absolute`, `splats.abs_grad`,
    in which the gradients of different tiles do not cancel. `splats.ids` must be distinct.
    norm_sum (N,) += |∂L/∂mean2d · (width/2, height/2)|, views (N,) += 1, and
    max_radii (N,) = max(max_radii, `splats.radii`) unless it is None.
    The factor scales the gradient to a screen that spans [-1, 1], as the threshold of the paper
    requires (section 5.2). Rows with id −1 or a non-finite gradient are skipped. If `valid`, (1,)
    bool, is False, all rows are skipped.

    Raises ValueError if there are no gradients or ids, or shapes or dtypes do not match.
    """
    op = "accumulate_screen_statistics"
    packed, ids = splats.packed, splats.ids
    grad = splats.abs_grad if absolute else packed.grad
    if grad is None or ids is None:
        raise ValueError(f"{op}: splats must have ids and a gradient")
    check_float(op, "splats", packed)
    check_tensor(op, "the gradient", grad, (len(packed), 2 if absolute else None), packed)
    check_size(op, width, height)
    check_tensor(op, "norm_sum", norm_sum, (None,), packed)
    check_tensor(op, "views", views, (len(norm_sum),), packed)
    if max_radii is not None:
        check_tensor(op, "max_radii", max_radii, (len(norm_sum),), packed)
    launch(
        variant(op, packed),
        n=len(packed),
        ids=ids,
        packed=packed.detach().contiguous(),
        stride=packed.shape[1],
        grad_means=grad.contiguous(),
        grad_stride=grad.shape[1],
        width=float(width),
        height=float(height),
        norm_sum=norm_sum,
        views=views,
        max_radii=max_radii,
        valid=valid,
    )
