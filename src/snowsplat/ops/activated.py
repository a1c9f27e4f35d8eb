"""`project_activated`: projects Gaussians that are given after the activations."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.check import check_float, check_tensor
from snowsplat.ops.gaussian_parameters import PARAMETERS, View, camera_params
from snowsplat.ops.native import Struct
from snowsplat.ops.projection import pose_gradient, project_vjp, visible_splats
from snowsplat.ops.splats import COLORS, DEPTHS, MEANS2D, OPACITIES, RADII, Splats2D, packed_width

#: Splats beyond this depth are removed: the default of gsplat.
FAR = 1e10


def project_activated(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colors: Tensor,
    view: View,
    *,
    far: float = FAR,
    radius_clip: float = 0.0,
) -> tuple[Splats2D, Tensor]:
    """`project` with the arguments of `gsplat.rasterization`: after the activations.

    Args:
        means: (N, 3) in world units.
        scales: (N, 3), at least 0, in world units: exp(log_scales).
        quats: (N, 4) wxyz, not necessarily normalised; zero means no rotation.
        opacities: (N,), in [0, 1]: sigmoid(opacity_logits).
        colors: (N, C) colours or features, any numbers; or (N, K, 3) coefficients of spherical
            harmonics, of which the first (view.sh_degree + 1)² are used.
        view: the camera and the options of the projection.
        far: splats of a larger depth, in world units, are removed.
        radius_clip: splats whose radius, `splats.radii`, is not larger, in pixels, are removed.

    All tensors are float32, or all are float64.

    Returns:
        The splats, without empty rows (a GPU waits for their number), and their centres (M, 2), in
        pixels, which are a view of the splats. The gradient of the centres, if it is retained, is
        that of `splats.means2d`: pass the centres, or a tensor that was computed from them, to
        `with_centres`. Gradients flow to every tensor, including the pose of the view.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op = "project_activated"
    check_float(op, "means", means)
    n = means.shape[0] if means.dim() else None
    check_tensor(op, "means", means, (n, 3), means)
    check_tensor(op, "scales", scales, (n, 3), means)
    check_tensor(op, "quats", quats, (n, 4), means)
    check_tensor(op, "opacities", opacities, (n,), means)
    harmonics = colors.dim() == 3
    check_tensor(op, "colors", colors, (n, None, 3) if harmonics else (n, None), means)
    if harmonics and colors.shape[1] < (view.sh_degree + 1) ** 2:
        raise ValueError(
            f"{op}: colors has too few coefficients ({colors.shape[1]}) for degree {view.sh_degree}"
        )
    camera = camera_params(view, means)
    limits = far, radius_clip
    packed, means2d, ids = _ProjectActivated.apply(
        view.sh_degree,
        limits,
        camera,
        camera["cam_from_world"],
        means,
        scales,
        quats,
        opacities,
        colors,
    )
    return Splats2D(packed, ids, 3 if harmonics else colors.shape[1]), means2d


def with_centres(splats: Splats2D, means2d: Tensor) -> Splats2D:
    """The splats of `project_activated`; the gradient of their centres flows to `means2d` (M, 2).

    The values of `means2d` must be those of the splats; they are not read.
    """
    return replace(splats, packed=_WithCentres.apply(splats.packed, means2d))


class _WithCentres(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, packed: Tensor, means2d: Tensor) -> Tensor:
        return packed.view_as(packed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_packed: Tensor) -> tuple[Tensor, Tensor]:
        # `_ProjectActivated` replaces these columns of the first one by the second one.
        return grad_packed, grad_packed[:, MEANS2D]


class _ProjectActivated(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        sh_degree: int,
        limits: tuple[float, float],
        camera: Struct,
        cam_from_world: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, scales, quats, opacities, colors = (p.detach().contiguous() for p in parameters)
        gaussians = _tensors(means, scales, quats, opacities, colors, sh_degree)
        packed, ids = visible_splats(gaussians, camera)
        far, radius_clip = limits
        # On a GPU, there is a row for every Gaussian.
        if len(ids) == len(means) or far < FAR or radius_clip > 0:
            kept = (ids >= 0) & (packed[:, DEPTHS] <= far) & (packed[:, RADII] > radius_clip)
            packed, ids = packed[kept], ids[kept]
        if colors.dim() == 2:
            packed = _with_colors(packed, colors, ids)
        ctx.mark_non_differentiable(ids)
        ctx.save_for_backward(cam_from_world, means, scales, quats, opacities, colors, ids)
        ctx.gaussians, ctx.camera = gaussians, camera
        # The mip filter multiplies the opacity of a Gaussian.
        ctx.factors = packed[:, OPACITIES] / opacities[ids] if camera["antialiased"] else None
        ctx.set_materialize_grads(False)
        return packed, packed[:, MEANS2D], ids

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_packed: Tensor | None, grad_means2d: Tensor | None, _: None
    ) -> tuple[Tensor | None, ...]:
        cam_from_world, means, scales, quats, opacities, colors, ids = ctx.saved_tensors
        if grad_packed is None:
            grad_packed = means.new_zeros(len(ids), packed_width(3))
        # The gradient of a splat's centre arrives separately: see `_WithCentres`.
        grad_packed = grad_packed.contiguous()
        if grad_means2d is None:
            grad_packed[:, MEANS2D] = 0.0
        elif grad_means2d.data_ptr() != grad_packed.data_ptr():
            grad_packed[:, MEANS2D] = grad_means2d
        harmonics = colors.dim() == 3
        d_means, d_log_scales, d_quats, d_logits, d_colors = (
            scratch.empty_like(t).zero_() for t in (means, scales, quats, opacities, colors)
        )
        # Without harmonics, the kernel's gradients of the colours are not used.
        d_dc, d_rest = _harmonics(d_colors) if harmonics else (scratch.empty_like(means), d_colors)
        grads = (d_means, d_log_scales, d_quats, d_logits, d_dc, d_rest)
        sums = project_vjp(
            "project_activated",
            ctx.gaussians,
            ctx.camera | {"cam_from_world": cam_from_world},
            ids,
            grad_packed[:, : packed_width(3)],
            dict(zip(PARAMETERS, grads, strict=True)),
            with_pose=ctx.needs_input_grad[3],
        )
        d_pose = pose_gradient(sums, cam_from_world)
        if not harmonics:
            found = grad_packed[:, COLORS : COLORS + colors.shape[1]]
            d_colors.index_copy_(0, ids.long(), found)
        d_scales = d_log_scales.div_(scales.clamp_min(torch.finfo(scales.dtype).tiny))
        # The derivative of the logit is inaccurate for opacities near 1, and 0 at 1.
        d_opacities, d_rows = d_logits.zero_(), grad_packed[:, OPACITIES]
        d_opacities.index_add_(0, ids, d_rows if ctx.factors is None else d_rows * ctx.factors)
        return None, None, None, d_pose, d_means, d_scales, d_quats, d_opacities, d_colors


def _tensors(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colors: Tensor,
    sh_degree: int,
) -> Struct:
    """The parameters that the native functions read.

    Without harmonics, the constants can be any numbers, because the colours that are computed from
    them are replaced.
    """
    harmonics = colors.dim() == 3
    sh_dc, sh_rest = _harmonics(colors) if harmonics else (means, colors)
    rows = colors.shape[1] if harmonics else 1
    return {
        "means": means,
        "log_scales": torch.log(scales, out=scratch.empty_like(scales)),
        "quats": quats,
        "opacity_logits": torch.logit(opacities, out=scratch.empty_like(opacities)),
        "sh_dc": sh_dc,
        "sh_rest": sh_rest,
        "sh_rest_rows": rows,
        "sh_degree": sh_degree if harmonics else 0,
        "sh_dc_rows": rows,
    }


def _harmonics(colors: Tensor) -> tuple[Tensor, Tensor]:
    """The arguments sh_dc and sh_rest of native functions, in the storage of `colors` (N, K, 3)."""
    return colors, colors.view(-1)[3:]


def _with_colors(packed: Tensor, colors: Tensor, ids: Tensor) -> Tensor:
    """`packed` (M, 16) with the rows `ids` of other colours (N, C)."""
    channels = colors.shape[1]
    end, width = COLORS + channels, packed_width(channels)
    if width > packed.shape[1]:
        packed = torch.nn.functional.pad(packed[:, :COLORS], (0, width - COLORS))
    torch.index_select(colors, 0, ids, out=packed[:, COLORS:end])
    packed[:, end : COLORS + 3] = 0.0  # the other colours that were there
    return packed
