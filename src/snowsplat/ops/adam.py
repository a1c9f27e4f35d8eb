"""`adam_step`: the backward pass of `project`, fused with Adam."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.check import check_ids, variant
from snowsplat.ops.gaussian_parameters import (
    PARAMETERS,
    GaussianParameters,
    View,
    camera_params,
    check_each,
    checked_parameters,
)
from snowsplat.ops.native import launch
from snowsplat.ops.projection import rows_expected
from snowsplat.ops.splats import SplatGradient


@dataclass(frozen=True)
class Moments:
    """The moments of Adam: a tensor for each of the six parameters, of the same name and shape."""

    exp_avg: Mapping[str, Tensor]  # m
    exp_avg_sq: Mapping[str, Tensor]  # v


@dataclass(frozen=True)
class AdamRates:
    """The numbers of a step of Adam.

    Attributes:
        lr: the learning rate of each of the six parameters.
        step: the number of this step, from 1 on (for the bias correction).
        betas: β₁ and β₂.
        eps: ε, inside the root.

    Raises:
        ValueError: a learning rate is missing, or the step is not at least 1.
    """

    lr: Mapping[str, float]
    step: int
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-15

    def __post_init__(self) -> None:
        missing = [name for name in PARAMETERS if name not in self.lr]
        if missing:
            raise ValueError(f"AdamRates: lr has no {', '.join(missing)}")
        if self.step < 1:
            raise ValueError(f"AdamRates: step counts from 1, got {self.step}")


@torch.no_grad()
def adam_step(
    gaussians: GaussianParameters,
    moments: Moments,
    gradient: SplatGradient,
    view: View,
    rates: AdamRates,
    *,
    visible_only: bool = False,
    valid: Tensor | None = None,
    nonfinite_rows: Tensor | None = None,
) -> None:
    """Propagates the gradient of the splats through `project` and takes one Adam step, in place.

    The gradients of the parameters are never written to memory. This halves the time of this part
    of a training step. `view` must be that passed to `project`.

    Args:
        gaussians: those passed to `project`; their tensors are contiguous. If `.grad` of a tensor
            is not None (from a regulariser), it is added to the gradient.
        moments: m and v, changed in place.
        gradient: of the splats. If `gradient.packed` is None, the gradient is only `.grad` of the
            tensors, and `gradient.ids` are the visible rows.
        rates: the learning rates, and the number of the step.
        visible_only: whether rows that are not in `gradient.ids` keep their values and moments. If
            False, their gradient is 0 (plus `.grad`), and their moments decay.
        valid: (1,) bool on the device; False skips the step. The CPU does not wait for the value.
            None means True.
        nonfinite_rows: (6,) int32 counts, in the order of the parameters; None disables counting.
            If the step would make a value infinite or NaN, the value and its moments stay
            unchanged, and its row is counted. So a non-finite gradient does not change the
            parameters.

    Rows of sh_rest beyond `view.sh_degree` keep their values and moments. The step is
    p −= lr · m̂ / √(v̂ + eps²) (Kingma & Ba 2015, but with ε inside the root).

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op = "adam_step"
    tensors = checked_parameters(op, gaussians, view.sh_degree)
    check_each(op, "exp_avg", moments.exp_avg, tensors)
    check_each(op, "exp_avg_sq", moments.exp_avg_sq, tensors)
    means, ids = tensors["means"], gradient.ids
    check_ids(op, ids, means)
    grad_packed = None if gradient.packed is None else gradient.checked(op, means)
    if nonfinite_rows is not None:
        fits = nonfinite_rows.shape == (len(PARAMETERS),) and nonfinite_rows.dtype == torch.int32
        if not (fits and nonfinite_rows.device == means.device and nonfinite_rows.is_contiguous()):
            raise ValueError(
                f"{op}: nonfinite_rows must be (6,) torch.int32 on {means.device}, "
                f"got {tuple(nonfinite_rows.shape)} {nonfinite_rows.dtype} "
                f"on {nonfinite_rows.device}"
            )
    beta1, beta2 = rates.betas
    updated: dict[str, Any] = {
        name: {
            "value": value.detach(),
            "m": moments.exp_avg[name],
            "v": moments.exp_avg_sq[name],
            "extra": None if value.grad is None else value.grad.contiguous(),
            "rate": float(rates.lr[name]) / (1 - beta1**rates.step),
        }
        for name, value in tensors.items()
    }
    done = launch(
        variant("adam_step", means),
        n=len(means),
        splats=len(ids),
        ids=ids,
        grad_packed=grad_packed,
        camera=camera_params(view, means),
        sh_rest_rows=tensors["sh_rest"].shape[1],
        sh_degree=view.sh_degree,
        **updated,
        beta1=float(beta1),
        beta2=float(beta2),
        inv_correction2=1 / (1 - beta2**rates.step),
        eps2=float(rates.eps) * float(rates.eps),
        visible_only=visible_only,
        valid=valid,
        nonfinite_rows=nonfinite_rows,
    )
    if done < 0:
        raise rows_expected(op)
