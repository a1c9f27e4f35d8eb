"""`project`: 3D Gaussians → the 2D splats that a camera sees."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.check import check_float, check_ids, check_size, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.params import (
    CameraParams,
    GaussianGradients,
    GaussianTensors,
    ProjectBackwardParams,
    ProjectCullParams,
    ProjectForwardParams,
    SizeQueryParams,
)
from snowsplat.ops.splats import Splats2D, packed_width
from snowsplat.ops.sums import sum_of_rows
from snowsplat.util.native_layout import POSE_SUMS


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh_dc: Tensor,
    sh_rest: Tensor,
    cam_from_world: Tensor,
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sh_degree: int,
    near: float = 0.2,
    antialiased: bool = False,
) -> Splats2D:
    """Projects N Gaussians to splats on a camera's image plane, without the invisible ones.

    On a GPU all rows are returned, because the CPU would have to wait in order to remove rows. The
    rows of invisible Gaussians are empty (zeros) and have the id -1.

    Args:
        means: (N, 3) in world units.
        log_scales: (N, 3).
        quats: (N, 4) wxyz, not necessarily normalised; zero means no rotation.
        opacity_logits: (N,).
        sh_dc: (N, 1, 3).
        sh_rest: (N, K, 3); the first (sh_degree + 1)² − 1 rows of each Gaussian are used.
        cam_from_world: (3, 4), with the axes of OpenCV.
        fx, fy, cx, cy: in pixels.
        near: > 0, in world units.
        antialiased: multiply the opacity by √(det(J W Σ Wᵀ Jᵀ) / det Σ'), so that the term d I
            below does not make small splats too prominent, and use d = 0.1: the 2D mip filter of Yu
            et al. 2024.

    All tensors are float32, or all are float64.

    The 2D covariance is Σ' = J W Σ Wᵀ Jᵀ + d I (Kerbl et al. 2023, eq. 5), d = 0.3 pixels²; the
    colour is max(0, ½ + Σ c_k Y_k(direction)). A Gaussian is visible if it lies beyond `near`, the
    opacity of its splat is at least 1/255, and the bounding box of its ellipse {α ≥ 1/255} overlaps
    the rectangle of the pixel centres. Gradients flow to every tensor, including the camera's pose.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    pose = cam_from_world.to(means.device, means.dtype, non_blocking=True)
    camera = camera_params("project", pose, width, height, fx, fy, cx, cy, near, antialiased)
    check_parameters("project", means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_degree)
    parameters = (means, log_scales, quats, opacity_logits, sh_dc, sh_rest)
    packed, ids = _Project.apply(sh_degree, camera, camera.cam_from_world, *parameters)
    return Splats2D(packed, ids, 3)


@torch.no_grad()
def add_project_gradients(
    params: Mapping[str, Tensor],
    grads: Mapping[str, Tensor],
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
) -> None:
    """Propagates the gradient of splats through `project`, and adds the result to ``grads``.

    So the gradients of several views can be summed before an `adam_step`. The camera arguments,
    `sh_degree` and `antialiased` must be those passed to `project`.

    Args:
        params: the parameters of the Gaussians, as for `adam_step`.
        grads: tensors of the same names and shapes, contiguous; changed in place.
        ids, packed_grad: `splats.ids` (M,), ascending, and `splats.packed.grad` (M, 16). On a GPU,
            rows with id -1 may be present or removed.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    tensors = {name: params[name].detach() for name in _NAMES}
    check_parameters("add_project_gradients", **tensors, sh_degree=sh_degree)
    means = tensors["means"]
    for name, tensor in tensors.items():
        shape = tuple(tensor.shape)
        check_tensor("add_project_gradients", f"grads[{name!r}]", grads[name], shape, tensor)
    shape = (len(ids), packed_width(3))
    check_tensor("add_project_gradients", "packed_grad", packed_grad, shape, means)
    check_ids("add_project_gradients", ids, means)
    pose = cam_from_world.to(means.device, means.dtype, non_blocking=True)
    camera = camera_params(
        *("add_project_gradients", pose, width, height, fx, fy, cx, cy), antialiased=antialiased
    )
    done = launch(
        variant("project_bwd", means),
        ProjectBackwardParams(
            n=len(ids),
            ids=ids,
            gaussians=gaussian_tensors(sh_degree, *(t.contiguous() for t in tensors.values())),
            camera=camera,
            grad_packed=packed_grad.contiguous(),
            grads=GaussianGradients(**{name: grads[name] for name in _NAMES}),
            pose=None,
        ),
    )
    if done < 0:
        raise ValueError(
            "add_project_gradients: on the CPU ids must be rows of the parameters; "
            "remove the splats of id -1"
        )


def camera_params(
    op: str,
    cam_from_world: Tensor,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    near: float = 0.2,
    antialiased: bool = False,
) -> CameraParams:
    """The camera, and how it filters, as a parameter of the native functions.

    Raises ValueError for an image without pixels, or a camera that is not finite or positive.
    """
    check_size(op, width, height)
    if cam_from_world.shape != (3, 4):
        raise ValueError(f"{op}: cam_from_world must be (3, 4), got {tuple(cam_from_world.shape)}")
    intrinsics = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "near": near}
    for name, value in intrinsics.items():
        positive = name in ("fx", "fy", "near")
        if not math.isfinite(value) or (positive and value <= 0):
            kind = "positive and finite" if positive else "finite"
            raise ValueError(f"{op}: {name} must be {kind}, got {value}")
    return CameraParams(
        cam_from_world=cam_from_world.contiguous(),
        width=float(width),
        height=float(height),
        fx=float(fx),
        fy=float(fy),
        cx=float(cx),
        cy=float(cy),
        near=float(near),
        antialiased=antialiased,
    )


def check_parameters(
    op: str,
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh_dc: Tensor,
    sh_rest: Tensor,
    sh_degree: int,
) -> None:
    """Raises ValueError unless the six tensors are parameters of the same Gaussians."""
    check_float(op, "means", means)
    count = means.shape[0] if means.dim() else None
    check_tensor(op, "means", means, (count, 3), means)
    check_tensor(op, "log_scales", log_scales, (count, 3), means)
    check_tensor(op, "quats", quats, (count, 4), means)
    check_tensor(op, "opacity_logits", opacity_logits, (count,), means)
    check_tensor(op, "sh_dc", sh_dc, (count, 1, 3), means)
    check_tensor(op, "sh_rest", sh_rest, (count, None, 3), means)
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"{op}: sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
    if sh_rest.shape[1] < (sh_degree + 1) ** 2 - 1:
        raise ValueError(
            f"{op}: sh_rest has too few rows ({sh_rest.shape[1]}) for degree {sh_degree}"
        )


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        sh_degree: int,
        camera: CameraParams,
        cam_from_world: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        parameters = tuple(p.detach().contiguous() for p in parameters)
        gaussians = gaussian_tensors(sh_degree, *parameters)
        means = gaussians.means
        ids = scratch.empty((len(means),), torch.int32, means.device)
        rows = launch(
            variant("project_cull", means),
            ProjectCullParams(n=len(means), gaussians=gaussians, camera=camera, ids=ids),
        )
        ids = ids[:rows]
        packed = scratch.empty((rows, packed_width(3)), means.dtype, means.device)
        launch(
            variant("project_fwd", means),
            ProjectForwardParams(
                n=rows, ids=ids, gaussians=gaussians, camera=camera, packed=packed
            ),
        )
        ctx.mark_non_differentiable(ids)
        ctx.save_for_backward(ids, cam_from_world, *parameters)
        ctx.sh_degree, ctx.camera = sh_degree, camera
        return packed, ids

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_packed: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        ids, cam_from_world, *parameters = ctx.saved_tensors
        grads = [torch.zeros_like(p) for p in parameters]
        pose = None
        if ctx.needs_input_grad[2]:
            blocks = launch("project_pose_blocks", SizeQueryParams(n=len(ids)), device=ids.device)
            pose = torch.empty(blocks, POSE_SUMS, dtype=torch.float64, device=ids.device)
        launch(
            variant("project_bwd", parameters[0]),
            ProjectBackwardParams(
                n=len(ids),
                ids=ids,
                gaussians=gaussian_tensors(ctx.sh_degree, *parameters),
                camera=replace(ctx.camera, cam_from_world=cam_from_world),
                grad_packed=grad_packed.contiguous(),
                grads=GaussianGradients(**dict(zip(_NAMES, grads, strict=True))),
                pose=pose,
            ),
        )
        d_pose = None if pose is None else pose_gradient(sum_of_rows(pose), cam_from_world)
        return None, None, d_pose, *grads


_NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


def gaussian_tensors(sh_degree: int, *parameters: Tensor) -> GaussianTensors:
    tensors = dict(zip(_NAMES, parameters, strict=True))
    return GaussianTensors(**tensors, sh_rest_rows=tensors["sh_rest"].shape[1], sh_degree=sh_degree)


def pose_gradient(sums: Tensor, cam_from_world: Tensor) -> Tensor:
    """The gradient (3, 4) of a pose from the kernel's sums.

    Args:
        sums: (16,): 9 for R, 3 for t, 3 for the centre c = −Rᵀ t. The last one, for the focal
            length, is not used.
    """
    d_rotation, d_translation, d_centre = sums[:9].view(3, 3), sums[9:12], sums[12:15]
    rotation, translation = cam_from_world[:, :3].double(), cam_from_world[:, 3].double()
    d_rotation = d_rotation - torch.outer(translation, d_centre)
    d_translation = d_translation - rotation @ d_centre
    return torch.cat([d_rotation, d_translation[:, None]], dim=1).to(cam_from_world.dtype)
