"""`camera_gradient`: from the gradient of splats to the camera that projected them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from snowsplat.ops.adam import PARAMETERS
from snowsplat.ops.check import check_ids, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.params import GaussianGradients, ProjectBackwardParams, SizeQueryParams
from snowsplat.ops.projection import (
    camera_params,
    check_parameters,
    gaussian_tensors,
    pose_gradient,
)
from snowsplat.ops.splats import packed_width
from snowsplat.ops.sums import sum_of_rows
from snowsplat.util.native_layout import POSE_SUMS

#: In double, (t + _ROUNDING) − _ROUNDING is t rounded to a multiple of 2⁻⁴⁰. Sums of such numbers
#: below 2¹³ are exact, so they do not depend on the order.
_ROUNDING = 1.5 * 2.0**12


@torch.no_grad()
def camera_gradient(
    params: Mapping[str, Tensor],
    ids: Tensor,
    packed_grad: Tensor,
    cam_from_world: Tensor,
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sh_degree: int,
    antialiased: bool = False,
    over_processes: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Propagates the gradient of splats through `project` to the camera, in one pass.

    All derivatives are included: those of the 2D means, of the 2D covariances and of the viewing
    directions, which determine the colours. The camera arguments, `sh_degree` and `antialiased`
    must be those passed to `project`.

    The gradient is computed from 16 sums over the splats. Each term is rounded to a multiple of
    2⁻⁴⁰, which is far below the gradients of a loss that is a mean over pixels. So the sums are
    exact up to 2¹³, and if the Gaussians are distributed over processes, the result is that of one
    process, to the bit.

    Args:
        params: the parameters of the Gaussians, as for `adam_step`.
        ids, packed_grad: `splats.ids` (M,), ascending, and `splats.packed.grad` (M, 16). On a GPU,
            rows with id -1 may be present or removed.
        over_processes: the sum of a tensor (16,) over all processes, if the Gaussians are
            distributed.

    Returns:
        (3, 4) float64: the gradient with respect to `cam_from_world`; and () float64: that with
        respect to the logarithm of a factor of both focal lengths. Both are on the device of the
        Gaussians.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op = "camera_gradient"
    tensors = {name: params[name].detach() for name in PARAMETERS}
    check_parameters(op, **tensors, sh_degree=sh_degree)
    means = tensors["means"]
    check_tensor(op, "packed_grad", packed_grad, (len(ids), packed_width(3)), means)
    check_ids(op, ids, means)
    pose = cam_from_world.to(means.device, means.dtype, non_blocking=True)
    blocks = launch("project_pose_blocks", SizeQueryParams(n=len(ids)), device=ids.device)
    sums = torch.empty(blocks, POSE_SUMS, dtype=torch.float64, device=ids.device)
    done = launch(
        variant("project_bwd", means),
        ProjectBackwardParams(
            n=len(ids),
            ids=ids,
            gaussians=gaussian_tensors(sh_degree, *(t.contiguous() for t in tensors.values())),
            camera=camera_params(op, pose, width, height, fx, fy, cx, cy, antialiased=antialiased),
            grad_packed=packed_grad.contiguous(),
            grads=GaussianGradients(),
            pose=sums,
            rounding=_ROUNDING,
        ),
    )
    if done < 0:
        raise ValueError(
            f"{op}: on the CPU ids must be rows of the parameters; remove the splats of id -1"
        )
    total = sum_of_rows(sums)
    if over_processes is not None:
        total = over_processes(total)
    return pose_gradient(total, pose.double()), total[15]
