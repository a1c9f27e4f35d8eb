"""`adam_step`: the backward pass of `project`, fused with Adam."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from snowsplat.ops.check import check_ids, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.params import AdamStepParams, AdamTensor
from snowsplat.ops.projection import camera_params, check_parameters
from snowsplat.ops.splats import packed_width

PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


@torch.no_grad()
def adam_step(
    params: Mapping[str, Tensor],
    exp_avg: Mapping[str, Tensor],
    exp_avg_sq: Mapping[str, Tensor],
    ids: Tensor,
    packed_grad: Tensor | None,
    cam_from_world: Tensor,
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sh_degree: int,
    lr: Mapping[str, float],
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    visible_only: bool = False,
    valid: Tensor | None = None,
    nonfinite_rows: Tensor | None = None,
    antialiased: bool = False,
) -> None:
    """Propagates the gradient of the splats through `project` and takes one Adam step, in place.

    The gradients of the parameters are never written to memory. This halves the time of this part
    of a training step. The camera arguments, `sh_degree` and `antialiased` must be those passed to
    `project`.

    Args:
        params: means, log_scales, quats, opacity_logits, sh_dc, sh_rest, with the shapes of
            `project`, contiguous. If `.grad` is not None (from a regulariser), it is added to the
            gradient.
        exp_avg, exp_avg_sq: the moments m and v, of the same names and shapes.
        ids, packed_grad: `splats.ids` (M,), ascending, and `splats.packed.grad` (M, 16). On a GPU,
            rows with id -1 may be present or removed. If `packed_grad` is None, the gradient is
            only `.grad`, and `ids` are the visible rows.
        lr: the learning rate of each parameter.
        step: the number of this step, from 1 on (for the bias correction).
        visible_only: whether rows that are not in `ids` keep their values and moments. If False,
            their gradient is 0 (plus `.grad`), and their moments decay.
        valid: (1,) bool on the device; False skips the step. The CPU does not wait for the value.
            None means True.
        nonfinite_rows: (6,) int32 counts, in the order of the parameters; None disables counting.
            If the step would make a value infinite or NaN, the value and its moments stay
            unchanged, and its row is counted. So a non-finite gradient does not change the
            parameters.

    Rows of sh_rest beyond `sh_degree` keep their values and moments. The step is
    p −= lr · m̂ / √(v̂ + eps²) (Kingma & Ba 2015, but with ε inside the root).

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    for what, given in (
        ("params", params),
        ("exp_avg", exp_avg),
        ("exp_avg_sq", exp_avg_sq),
        ("lr", lr),
    ):
        missing = [name for name in PARAMETERS if name not in given]
        if missing:
            raise ValueError(f"adam_step: {what} has no {', '.join(missing)}")
    tensors = [params[name] for name in PARAMETERS]
    check_parameters(
        "adam_step", **dict(zip(PARAMETERS, tensors, strict=True)), sh_degree=sh_degree
    )
    means = tensors[0]
    if packed_grad is not None:
        check_tensor("adam_step", "packed_grad", packed_grad, (len(ids), packed_width(3)), means)
        packed_grad = packed_grad.contiguous()
    check_ids("adam_step", ids, means)
    if nonfinite_rows is not None:
        fits = nonfinite_rows.shape == (len(PARAMETERS),) and nonfinite_rows.dtype == torch.int32
        if not (fits and nonfinite_rows.device == means.device and nonfinite_rows.is_contiguous()):
            raise ValueError(
                f"adam_step: nonfinite_rows must be (6,) torch.int32 on {means.device}, "
                f"got {tuple(nonfinite_rows.shape)} {nonfinite_rows.dtype} "
                f"on {nonfinite_rows.device}"
            )
    if step < 1:
        raise ValueError(f"adam_step: step counts from 1, got {step}")
    tensor_params = {}
    for name, value in zip(PARAMETERS, tensors, strict=True):
        m, v = exp_avg[name], exp_avg_sq[name]
        shape = tuple(value.shape)
        check_tensor("adam_step", f"exp_avg[{name!r}]", m, shape, value)
        check_tensor("adam_step", f"exp_avg_sq[{name!r}]", v, shape, value)
        tensor_params[name] = AdamTensor(
            value=value.detach(),
            m=m,
            v=v,
            extra=None if value.grad is None else value.grad.contiguous(),
            rate=float(lr[name]) / (1 - betas[0] ** step),
        )
    pose = cam_from_world.to(means.device, means.dtype, non_blocking=True)
    done = launch(
        variant("adam_step", means),
        AdamStepParams(
            n=len(means),
            splats=len(ids),
            ids=ids,
            grad_packed=packed_grad,
            camera=camera_params(
                *("adam_step", pose, width, height, fx, fy, cx, cy), antialiased=antialiased
            ),
            sh_rest_rows=tensors[5].shape[1],
            sh_degree=sh_degree,
            **tensor_params,
            beta1=float(betas[0]),
            beta2=float(betas[1]),
            inv_correction2=1 / (1 - betas[1] ** step),
            eps2=float(eps) * float(eps),
            visible_only=visible_only,
            valid=valid,
            nonfinite_rows=nonfinite_rows,
        ),
    )
    if done < 0:
        raise ValueError(
            "adam_step: on the CPU ids must be rows of the parameters; remove the splats of id -1"
        )
