"""`project`: 3D Gaussians → the 2D splats that a camera sees."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.check import variant
from snowsplat.ops.gaussian_parameters import (
    PARAMETERS,
    GaussianParameters,
    View,
    camera_params,
    check_each,
    checked_parameters,
    gaussian_tensors,
)
from snowsplat.ops.native import Struct, launch, query_size
from snowsplat.ops.splats import SplatGradient, Splats2D, packed_width
from snowsplat.util.native_layout import POSE_SUMS


def project(gaussians: GaussianParameters, view: View) -> Splats2D:
    """Projects N Gaussians to splats on the image plane of a view, without the invisible ones.

    On a GPU all rows are returned, because the CPU would have to wait in order to remove rows. The
    rows of invisible Gaussians are empty (zeros) and have the id -1.

    Args:
        gaussians: means, log_scales (N, 3), quats (N, 4), opacity_logits (N,), sh_dc (N, 1, 3) and
            sh_rest (N, K, 3) of a `snowsplat.Gaussians` or of any object with these attributes. The
            first (view.sh_degree + 1)² − 1 rows of sh_rest of each Gaussian are used. All tensors
            are float32, or all are float64.
        view: the camera and the options of the projection.

    The 2D covariance is Σ' = J W Σ Wᵀ Jᵀ + d I (Kerbl et al. 2023, eq. 5), d = 0.3 pixels²; if the
    view is antialiased, d = 0.1, and the opacity is multiplied by √(det(J W Σ Wᵀ Jᵀ) / det Σ'), so
    that the term d I does not make small splats too prominent (the 2D mip filter of Yu et al.
    2024). The colour is max(0, ½ + Σ c_k Y_k(direction)). A Gaussian is visible if it lies beyond
    `view.near`, the opacity of its splat is at least 1/255, and the bounding box of its ellipse
    {α ≥ 1/255} overlaps the rectangle of the pixel centres. Gradients flow to every tensor,
    including the pose of the view.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    tensors = checked_parameters("project", gaussians, view.sh_degree)
    camera = camera_params(view, gaussians.means)
    packed, ids = _Project.apply(
        view.sh_degree, camera, camera["cam_from_world"], *tensors.values()
    )
    return Splats2D(packed, ids, 3)


@torch.no_grad()
def add_project_gradients(
    gaussians: GaussianParameters,
    grads: Mapping[str, Tensor],
    gradient: SplatGradient,
    view: View,
) -> None:
    """Propagates the gradient of splats through `project`, and adds the result to ``grads``.

    So the gradients of several views can be summed before an `adam_step`. `gaussians` and `view`
    must be those passed to `project`.

    Args:
        grads: a tensor for each of the six parameters of the Gaussians, of the same name and shape,
            contiguous; changed in place.
        gradient: of the splats; `gradient.packed` must not be None.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op = "add_project_gradients"
    tensors = checked_parameters(op, gaussians, view.sh_degree)
    check_each(op, "grads", grads, tensors)
    means = tensors["means"]
    project_vjp(
        op,
        gaussian_tensors(tensors, view.sh_degree),
        camera_params(view, means),
        gradient.ids,
        gradient.checked(op, means),
        grads,
    )


def rows_expected(op: str) -> ValueError:
    """The error of a native function that was given the id -1 on the CPU."""
    return ValueError(
        f"{op}: on the CPU ids must be rows of the parameters; remove the splats of id -1"
    )


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        sh_degree: int,
        camera: Struct,
        cam_from_world: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        parameters = tuple(p.detach().contiguous() for p in parameters)
        gaussians = gaussian_tensors(dict(zip(PARAMETERS, parameters, strict=True)), sh_degree)
        packed, ids = visible_splats(gaussians, camera)
        ctx.mark_non_differentiable(ids)
        ctx.save_for_backward(ids, cam_from_world, *parameters)
        ctx.sh_degree, ctx.camera = sh_degree, camera
        return packed, ids

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_packed: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        ids, cam_from_world, *parameters = ctx.saved_tensors
        named = dict(zip(PARAMETERS, parameters, strict=True))
        grads = {name: torch.zeros_like(p) for name, p in named.items()}
        sums = project_vjp(
            "project",
            gaussian_tensors(named, ctx.sh_degree),
            ctx.camera | {"cam_from_world": cam_from_world},
            ids,
            grad_packed,
            grads,
            with_pose=ctx.needs_input_grad[2],
        )
        return None, None, pose_gradient(sums, cam_from_world), *grads.values()


def visible_splats(gaussians: Struct, camera: Struct) -> tuple[Tensor, Tensor]:
    """`packed` (M, 16) and `ids` (M,) of the splats of the visible Gaussians; see `Splats2D`."""
    means = gaussians["means"]
    inputs: dict[str, Any] = {"gaussians": gaussians, "camera": camera}
    ids = scratch.empty((len(means),), torch.int32, means.device)
    rows = launch(variant("project_cull", means), n=len(means), ids=ids, **inputs)
    ids = ids[:rows]
    packed = scratch.empty((rows, packed_width(3)), means.dtype, means.device)
    launch(variant("project_fwd", means), n=rows, ids=ids, packed=packed, **inputs)
    return packed, ids


def project_vjp(
    op: str,
    gaussians: Struct,
    camera: Struct,
    ids: Tensor,
    grad_packed: Tensor,
    grads: Mapping[str, Tensor | None],
    *,
    with_pose: bool = False,
    rounding: float = 0.0,
) -> Tensor | None:
    """Adds the gradients of the parameters to `grads`, by name; None: it is not computed.

    Returns the sums (16,) float64 for `pose_gradient`, or None. For `rounding` see
    `native/params.h`.

    Raises ValueError, which names `op`, if `ids` has the id -1 on the CPU.
    """
    sums = None
    if with_pose:
        blocks = query_size("project_pose_blocks", ids.device, len(ids))
        sums = torch.empty(blocks, POSE_SUMS, dtype=torch.float64, device=ids.device)
    done = launch(
        variant("project_bwd", gaussians["means"]),
        n=len(ids),
        ids=ids,
        gaussians=gaussians,
        camera=camera,
        grad_packed=grad_packed.contiguous(),
        grads={name: grads[name] for name in PARAMETERS},
        pose=sums,
        rounding=rounding,
    )
    if done < 0:
        raise rows_expected(op)
    return None if sums is None else sum_of_rows(sums)


def pose_gradient(sums: Tensor | None, cam_from_world: Tensor) -> Tensor | None:
    """The gradient (3, 4) of a pose from the sums of `project_vjp`; None without them.

    ``sums``: (16,): 9 for R, 3 for t, 3 for the centre c = −Rᵀ t. The last one, for the focal
    length, is not used.
    """
    if sums is None:
        return None
    d_rotation, d_translation, d_centre = sums[:9].view(3, 3), sums[9:12], sums[12:15]
    rotation, translation = cam_from_world[:, :3].double(), cam_from_world[:, 3].double()
    d_rotation = d_rotation - torch.outer(translation, d_centre)
    d_translation = d_translation - rotation @ d_centre
    return torch.cat([d_rotation, d_translation[:, None]], dim=1).to(cam_from_world.dtype)


def sum_of_rows(rows: Tensor) -> Tensor:
    """(R, C) → (C,), bit-identical for any number of threads of torch.

    On the CPU, rows are added in order. On a GPU, torch's sum has a fixed order; its cumsum does
    not.
    """
    if rows.is_cuda or len(rows) == 0:
        return rows.sum(0)
    return rows.cumsum(0)[-1]
