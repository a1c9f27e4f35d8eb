"""`accumulate_screen_statistics`: what density control has to know of the splats of a view."""

from __future__ import annotations

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
) -> None:
    """Adds one view to the statistics of the N Gaussians, at the rows that it sees, in place.

    With the gradient in `splats.packed.grad` and distinct `splats.ids`:
    norm_sum (N,) += |∂L/∂mean2d · (width/2, height/2)|, views (N,) += 1, and
    max_radii (N,) = max(max_radii, `splats.radii`) unless None. The factor states the gradient for
    a screen that spans [-1, 1], as the paper's threshold is (section 5.2). Rows of id −1 are
    passed over, as those of a gradient that is not finite, and where `valid` (1,) bool is False
    all are.

    Raises ValueError where there is no gradient, no ids, or shapes or dtypes do not fit.
    """
    op = "accumulate_screen_statistics"
    packed, grad, ids = splats.packed, splats.packed.grad, splats.ids
    if grad is None or ids is None:
        raise ValueError(f"{op}: splats must have ids and a gradient")
    check_float(op, "splats", packed)
    check_size(op, width, height)
    check_tensor(op, "norm_sum", norm_sum, (None,), packed)
    check_tensor(op, "views", views, (len(norm_sum),), packed)
    if max_radii is not None:
        check_tensor(op, "max_radii", max_radii, (len(norm_sum),), packed)
    launch(
        variant(op, packed),
        len(packed),
        ids,
        packed.detach().contiguous(),
        grad.contiguous(),
        packed.shape[1],
        float(width),
        float(height),
        norm_sum,
        views,
        max_radii,
        valid,
    )
