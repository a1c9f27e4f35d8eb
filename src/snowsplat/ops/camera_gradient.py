"""`camera_gradient`: from the gradient of splats to the camera that projected them."""

from collections.abc import Callable

import torch
from torch import Tensor

from snowsplat.ops.gaussian_parameters import (
    PARAMETERS,
    GaussianParameters,
    View,
    camera_params,
    checked_parameters,
    gaussian_tensors,
)
from snowsplat.ops.projection import pose_gradient, project_vjp
from snowsplat.ops.splats import SplatGradient

#: In double, (t + _ROUNDING) − _ROUNDING is t rounded to a multiple of 2⁻⁴⁰. Sums of such numbers
#: below 2¹³ are exact, so they do not depend on the order.
_ROUNDING = 1.5 * 2.0**12


@torch.no_grad()
def camera_gradient(
    gaussians: GaussianParameters,
    gradient: SplatGradient,
    view: View,
    *,
    over_processes: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Propagates the gradient of splats through `project` to the camera, in one pass.

    All derivatives are included: those of the 2D means, of the 2D covariances and of the viewing
    directions, which determine the colours. `gaussians` and `view` must be those passed to
    `project`.

    The gradient is computed from 16 sums over the splats. Each term is rounded to a multiple of
    2⁻⁴⁰, which is far below the gradients of a loss that is a mean over pixels. So the sums are
    exact up to 2¹³, and if the Gaussians are distributed over processes, the result is that of one
    process, to the bit.

    Args:
        gradient: of the splats; `gradient.packed` must not be None.
        over_processes: the sum of a tensor (16,) over all processes, if the Gaussians are
            distributed.

    Returns:
        (3, 4) float64: the gradient with respect to `cam_from_world`; and () float64: that with
        respect to the logarithm of a factor of both focal lengths. Both are on the device of the
        Gaussians.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op = "camera_gradient"
    tensors = checked_parameters(op, gaussians, view.sh_degree)
    means, ids = tensors["means"], gradient.ids
    grad_packed = gradient.checked(op, means)
    camera = camera_params(view, means)
    total = project_vjp(
        op,
        gaussian_tensors(tensors, view.sh_degree),
        camera,
        ids,
        grad_packed,
        dict.fromkeys(PARAMETERS),
        with_pose=True,
        rounding=_ROUNDING,
    )
    assert total is not None
    if over_processes is not None:
        total = over_processes(total)
    gradient_of_pose = pose_gradient(total, camera["cam_from_world"].double())
    assert gradient_of_pose is not None
    return gradient_of_pose, total[15]
