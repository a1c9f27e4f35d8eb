"""`rasterization`: the call of gsplat, on a CPU as well as on a GPU."""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from snowsplat.ops.activated import project_activated, with_centres
from snowsplat.ops.check import check_size
from snowsplat.ops.gaussian_parameters import View
from snowsplat.ops.rasterizer import rasterize
from snowsplat.ops.reference import JACOBIAN_MARGIN, sh_basis
from snowsplat.ops.splats import Splats2D, radii_of_conics
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import TILE

#: eps2d of each `rasterize_mode` for which there are kernels. For others, and for covariances,
#: PyTorch computes the shapes of the splats.
_EPS2D = {"classic": 0.3, "antialiased": 0.1}
_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
#: The value of each argument of gsplat that has only one here, and what to do.
_FIXED: dict[str, tuple[Any, str]] = {
    "distributed": (False, "train in several processes with `snowsplat train --processes`"),
    "camera_model": ("pinhole", "undistort the photos, and use pinhole cameras"),
    "with_ut": (False, "leave it out, and use pinhole cameras"),
    "with_eval3d": (False, "leave it out, and use pinhole cameras"),
    "radial_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "tangential_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "thin_prism_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "ftheta_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "rolling_shutter": (None, "use photos of a global shutter"),
    "viewmats_rs": (None, "use photos of a global shutter"),
    "return_normals": (False, "leave it out"),
    "global_z_order": (True, "Gaussians are sorted by their depth; leave it out"),
    "rays": (None, "use pinhole cameras"),
    "lidar_coeffs": (None, "use pinhole cameras"),
    "external_distortion_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "ut_params": (None, "leave it out, and use pinhole cameras"),
    "renderer_config": (None, "leave it out"),
}
#: Names of those defaults of gsplat that are objects.
_DEFAULTS = ("RollingShutterType.GLOBAL", "RendererConfig_MixedBatch")
_P = ParamSpec("_P")
_R = TypeVar("_R")


def _outside_graphs(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """`torch.compile` breaks its graph at a call: it cannot look into native kernels."""

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if torch.compiler.is_compiling():  # `disable` takes seconds to import
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return call


@_outside_graphs
def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object = None,
    lidar_coeffs: object = None,
    external_distortion_coeffs: object = None,
    rolling_shutter: object = None,
    viewmats_rs: Tensor | None = None,
    ut_params: object = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: object = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras: the arguments and results of `gsplat.rasterization`.

    A script that calls gsplat runs on a CPU (or on a GPU, if its tensors are there) after one
    changed import: ``from snowsplat import rasterization``. All tensors are float32, or all are
    float64, and on one device. "…" are batch dimensions, or none.

    Args:
        means: (…, N, 3) in world units.
        quats: (…, N, 4) wxyz, not necessarily normalised.
        scales: (…, N, 3) standard deviations in world units; the sign does not matter.
        opacities: (…, N), in [0, 1].
        colors: without `sh_degree`, (…, N, D) or (…, C, N, D): colours or features, any numbers.
            With `sh_degree`, (N, K, 3), (…, N, K, 3) or (…, C, N, K, 3): coefficients of spherical
            harmonics, K ≥ (sh_degree + 1)². None for depths alone.
        viewmats: (…, C, 4, 4) from the world to the camera, with the axes of OpenCV.
        Ks: (…, C, 3, 3) intrinsics, in pixels, without skew. They get no gradient.
        width, height: of the images, in pixels.
        near_plane, far_plane: Gaussians with a depth outside of these limits are not visible.
        radius_clip: Gaussians with a radius up to this one, in pixels, are not visible. The radius
            is 3 σ of the major axis.
        eps2d: of the low-pass filter, in pixels². For 0.3 with "classic" and 0.1 with
            "antialiased" there are kernels; others are slower.
        sh_degree: None, or 0 to 3.
        packed: whether `meta` has rows of the visible Gaussians only. The images are the same.
        tile_size, channel_chunk, segmented: accepted for compatibility; they change nothing.
        backgrounds: (…, C, D); None is black. Depths have the background 0.
        render_mode: "RGB", "D" (depth Σ T α z), "ED" (expected depth: D / alpha), "RGB+D" or
            "RGB+ED". "RGB" are the colours or features.
        sparse_grad: the gradients of means, quats and scales are sparse (COO), with the rows of the
            visible Gaussians. Only for packed, and without batch dimensions.
        absgrad: the backward pass fills ``meta["means2d"].absgrad``, the sums of absolute gradients
            of the centres over the tiles of 16×16 pixels. gsplat sums over pixels, which is more.
            Of more than four channels, with the depth, it is the sum over groups of four.
        rasterize_mode: "classic"; or "antialiased", which is the 2D mip filter.
        covars: (…, N, 3, 3), used instead of quats and scales.
        extra_signals: features (…, N, E) or (…, C, N, E), or (N, K, E) coefficients of spherical
            harmonics of the degree `extra_signals_sh_degree`, which are not clamped.
        distributed, camera_model, …: the other arguments of gsplat; only their defaults are
            possible.

    Returns:
        render_colors (…, C, height, width, X), where X is D, 1 or D + 1. For "RGB", the storage is
        planar, as `ops.photometric_loss` reads it: use `reshape` instead of `view`.

        render_alphas (…, C, height, width, 1).

        meta: a dictionary of intermediate results, with a row for each of the V visible Gaussians
        of all cameras: "means2d" (V, 2), "conics" (V, 3), "depths" (V,), "opacities" (V,), "radii"
        (V, 2) int32 (here both are 3 σ of the major axis, rounded up), and their "batch_ids",
        "camera_ids" and "gaussian_ids" (V,) int64. With ``packed=False``, the shapes are
        (…, C, N, 2) and so on, with zeros for the others, and the ids are None. "means2d" is
        between the Gaussians and the image, so that ``meta["means2d"].retain_grad()`` keeps its
        gradient for a density control. Also "width", "height", "tile_size", "tile_width",
        "tile_height", "n_batches" and "n_cameras", but not the lists of intersections; and
        "render_extra_signals" (…, C, height, width, E), if there are any, on the background 0.

    Gradients flow to means, quats, scales, covars, opacities, colors, extra_signals, viewmats and
    backgrounds.

    Difference from the images of gsplat 1.6: the filter of "antialiased" multiplies opacities by a
    factor that may be as small as it is; in gsplat, it is at least 0.005.

    Raises:
        UserError: an argument has a value that gsplat supports and snowsplat does not.
        ValueError: shapes, dtypes or devices do not match.
    """
    given = locals()
    _refuse_unsupported({name: given[name] for name in _FIXED}, eps2d, render_mode, rasterize_mode)
    for name in ("sh_degree", "extra_signals_sh_degree"):
        degree = given[name]
        if degree is not None and not 0 <= degree <= 3:
            raise UserError(
                "rasterization: {name}={degree} is not supported; use 0 to 3",
                name=name,
                degree=degree,
            )
    check_size("rasterization", width, height)
    with_colors, with_depth = render_mode.startswith("RGB"), render_mode != "RGB"
    *batch, n, _ = means.shape
    visible: list[Tensor] = []
    if sparse_grad and packed:
        if batch:
            raise UserError(
                "rasterization: sparse_grad is not supported for batches; use sparse_grad=False"
            )
        means = _RowGradient.apply(means, visible)
        if covars is None and quats is not None and scales is not None:
            quats, scales = (_RowGradient.apply(tensor, visible) for tensor in (quats, scales))
    if not with_colors:  # a depth needs no colours; one feature is the cheapest
        colors, sh_degree, backgrounds = means[..., :1].detach(), None, None
    if covars is not None:
        quats, scales = means.new_zeros(*batch, n, 4), means.new_ones(*batch, n, 3)
    if colors is None or quats is None or scales is None:
        raise ValueError("rasterization: colors are needed, and quats and scales, or covars")
    if sh_degree is not None and colors.dim() == 3:
        colors = colors.expand(*batch, *colors.shape)
    scales = scales.abs()
    if viewmats.dim() != len(batch) + 3:
        what = f"viewmats must be {(*batch, 'C', 4, 4)}, got {tuple(viewmats.shape)}"
        raise ValueError(f"rasterization: {what}; for one camera, C is 1: viewmats[None]")
    of_views = (*batch, *viewmats.shape[-3:-2])
    row: tuple[int, ...] = colors.shape[-1:] if sh_degree is None else colors.shape[-2:]
    per_camera = colors.dim() - len(row) == len(batch) + 2
    harmonic = extra_signals_sh_degree is not None
    for name, tensor, shape in (
        ("quats", quats, (*batch, n, 4)),
        ("scales", scales, (*batch, n, 3)),
        ("covars", covars, (*batch, n, 3, 3)),
        ("opacities", opacities, (*batch, n)),
        ("colors", colors, (*(of_views if per_camera else batch), n, *row)),
        ("viewmats", viewmats, (*of_views, 4, 4)),
        ("Ks", Ks, (*of_views, 3, 3)),
        ("backgrounds", backgrounds, (*of_views, row[-1])),
        ("extra_signals", extra_signals, _shape_of_signals(extra_signals, of_views, n, harmonic)),
    ):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"rasterization: {name} must be {shape}, got {tuple(tensor.shape)}")

    signals = 0
    if extra_signals is not None:
        signals = extra_signals.shape[-1]
        parts = [_features(extra_signals, extra_signals_sh_degree, means, viewmats)]
        if with_colors:
            own = _features(colors, sh_degree, means, viewmats)
            parts.insert(0, own if sh_degree is None else own.clamp_min(0.0))
        if backgrounds is not None:
            backgrounds = torch.nn.functional.pad(backgrounds, (0, signals))
        colors, sh_degree, per_camera = torch.cat(parts, -1), None, True
        row = colors.shape[-1:]
    if covars is None and eps2d != _EPS2D[rasterize_mode]:
        factors = rotation_from_quat(quats) * scales[..., None, :]
        covars = factors @ factors.mT
    each_covars = [] if covars is None else _items(covars, 3)
    cameras = of_views[-1]
    each_means, each_scales, each_quats = (_items(t, 2) for t in (means, scales, quats))
    each_opacities, each_colors = _items(opacities, 1), _items(colors, 1 + len(row))
    poses, intrinsics = _items(viewmats, 2), Ks.reshape(-1, 3, 3).tolist()
    projected = []
    for i, (pose, ((fx, skew, cx), (_, fy, cy), _)) in enumerate(
        zip(poses, intrinsics, strict=True)
    ):
        if skew != 0:
            raise UserError(
                "rasterization: Ks has the skew {skew:g}; undistort the photos", skew=skew
            )
        view = View(
            *(pose[:3], width, height, fx, fy, cx, cy),
            sh_degree=0 if sh_degree is None else sh_degree,
            near=near_plane,
            antialiased=rasterize_mode == "antialiased" and covars is None,
        )
        b = i // cameras
        splats, means2d = project_activated(
            each_means[b],
            _balls(each_means[b], each_covars[b], view, eps2d) if each_covars else each_scales[b],
            each_quats[b],
            each_opacities[b],
            each_colors[i if per_camera else b],
            view,
            far=far_plane,
            radius_clip=0.0 if each_covars else radius_clip,
        )
        if each_covars:
            mip = rasterize_mode == "antialiased"
            splats = _reshaped(splats, each_means[b], each_covars[b], view, eps2d, mip, radius_clip)
        projected.append((splats, means2d))
    visible += [splats.ids.long() for splats, _ in projected if splats.ids is not None]
    meta, centres = _meta(projected, packed, of_views, n)
    meta |= {
        "width": width,
        "height": height,
        "tile_size": TILE,
        "tile_width": -(-width // TILE),
        "tile_height": -(-height // TILE),
        "n_batches": math.prod(batch),
        "n_cameras": cameras,
    }

    if absgrad:
        _keep_absgrad(meta["means2d"], projected, packed)
    images, alphas, extras = [], [], []
    behind = [None] * len(projected) if backgrounds is None else _items(backgrounds, 1)
    for (splats, _), means2d, background in zip(projected, centres, behind, strict=True):
        splats = with_centres(splats, means2d)
        image, alpha, depth = rasterize(splats, width, height, background, with_depth=with_depth)
        if signals:
            extras.append(image[..., -signals:])
            image = image[..., :-signals]
        if depth is not None:
            if render_mode.endswith("ED"):
                depth = depth / alpha.clamp(min=1e-10)
            depth = depth[..., None]
            image = torch.cat([image, depth], dim=2) if with_colors else depth
        images.append(image)
        alphas.append(alpha[..., None])
    if signals:
        meta["render_extra_signals"] = _stack_images(extras, of_views)
    return _stack_images(images, of_views), _stack_images(alphas, of_views), meta


class _RowGradient(torch.autograd.Function):
    """The identity, of tensors (N, …). Its gradient is sparse, with the rows in `visible`, a list
    that is filled before the backward pass."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, visible: list[Tensor]) -> Tensor:
        ctx.visible = visible
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        rows = torch.cat(ctx.visible).unique()
        return torch.sparse_coo_tensor(
            rows[None], grad[rows], grad.shape, check_invariants=False
        ), None


def _shape_of_signals(
    signals: Tensor | None, of_views: tuple[int, ...], n: int, harmonic: bool
) -> tuple[int, ...]:
    if signals is None:
        return ()
    if harmonic:
        return (n, *signals.shape[-2:])
    items = of_views if signals.dim() == len(of_views) + 2 else of_views[:-1]
    return (*items, n, signals.shape[-1])


def _features(values: Tensor, degree: int | None, means: Tensor, viewmats: Tensor) -> Tensor:
    """Features (…, C, N, D) of each camera, from features or harmonics, which are not clamped."""
    of_views = (*viewmats.shape[:-2], means.shape[-2])
    if values.dim() == viewmats.dim() - (degree is None):  # the same of all cameras
        values = values.unsqueeze(-3 if degree is None else -4)
    if degree is None:
        return values.expand(*of_views, -1)
    if values.shape[-2] < (count := (degree + 1) ** 2):
        what = f"got {values.shape[-2]} coefficients"
        raise ValueError(f"rasterization: degree {degree} needs {count}, {what}")
    rotations, shifts = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    towards = means[..., None, :, :] + (rotations.mT @ shifts).mT  # the camera is at −Rᵀ t
    towards = torch.nn.functional.normalize(towards, dim=-1).flatten(0, -2)
    basis = sh_basis(towards, degree).unflatten(0, of_views)
    return 0.5 + (basis[..., None] * values[..., :count, :]).sum(-2)


def _refuse_unsupported(
    given: dict[str, Any], eps2d: float, render_mode: str, rasterize_mode: str
) -> None:
    for name, value in given.items():
        only, remedy = _FIXED[name]
        names = {str(value), type(value).__name__}
        if value is not only and value != only and names.isdisjoint(_DEFAULTS):
            raise UserError(
                "rasterization: {name} is not supported; {remedy}", name=name, remedy=remedy
            )
    if render_mode not in _RENDER_MODES:
        what = f"render_mode={render_mode!r} is not supported; use {', '.join(_RENDER_MODES)}"
        raise UserError("rasterization: {what}", what=what)
    if rasterize_mode not in _EPS2D:
        what = f"rasterize_mode={rasterize_mode!r} is not supported; use {' or '.join(_EPS2D)}"
        raise UserError("rasterization: {what}", what=what)
    if not 0.0 < eps2d < math.inf:
        raise UserError("rasterization: eps2d={eps2d} is not positive; use 0.3", eps2d=eps2d)


@torch.no_grad()
def _balls(means: Tensor, covars: Tensor, view: View, eps2d: float) -> Tensor:
    """Scales (N, 3) of balls that cover the Gaussians in the view, also with a wider filter."""
    depths = means @ view.cam_from_world[2, :3].to(means) + view.cam_from_world[2, 3].to(means)
    wider = max(0.0, eps2d - _EPS2D["classic"]) * (depths / min(view.fx, view.fy)).square()
    return (covars.diagonal(dim1=1, dim2=2).sum(1) + wider).sqrt()[:, None].expand(-1, 3)


def _reshaped(
    splats: Splats2D,
    means: Tensor,
    covars: Tensor,
    view: View,
    eps2d: float,
    mip: bool,
    radius_clip: float,
) -> Splats2D:
    """The splats with the shapes of covariances (N, 3, 3) after a low-pass filter; see
    `ops.reference.project`. ``mip``: the filter keeps the integral of a splat."""
    assert splats.ids is not None
    rows = splats.ids.long()
    pose = view.cam_from_world.to(means.device, torch.float64)
    turn = pose[:, :3]
    x, y, z = (means[rows].double() @ turn.T + pose[:, 3]).unbind(1)
    tx, ty = (
        (f * at / z).clamp(-c - JACOBIAN_MARGIN * side, (1 + JACOBIAN_MARGIN) * side - c) / z
        for at, f, c, side in (
            (x, view.fx, view.cx, view.width),
            (y, view.fy, view.cy, view.height),
        )
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack([view.fx / z, zero, -tx, zero, view.fy / z, -ty], 1)
    affine = jacobian.reshape(-1, 2, 3) @ turn
    shapes = affine @ covars[rows].double() @ affine.mT
    xx, xy, yy = shapes[:, 0, 0], shapes[:, 0, 1], shapes[:, 1, 1]
    sharp = (xx * yy - xy * xy).clamp_min(0.0)
    det = sharp + eps2d * (xx + yy) + eps2d**2
    conics = torch.stack([(yy + eps2d) / det, -xy / det, (xx + eps2d) / det], 1).to(means)
    opacities, radii = splats.opacities, radii_of_conics(conics)
    if mip:
        opacities = opacities * (sharp / det).clamp_min(1e-12).sqrt().to(means)
    opacities = torch.where(radii > radius_clip, opacities, 0.0)
    return Splats2D.pack(
        splats.means2d, conics, opacities, splats.depths, splats.colors, radii, splats.ids
    )


def _keep_absgrad(means2d: Tensor, projected: list[tuple[Splats2D, Tensor]], packed: bool) -> None:
    """Let the backward pass fill ``means2d.absgrad``, in the shape of ``means2d``."""
    kept = torch.zeros_like(means2d)
    means2d.absgrad = kept  # type: ignore[attr-defined]
    parts = kept.split([len(splats) for splats, _ in projected]) if packed else ()
    for i, (splats, _) in enumerate(projected):
        splats.abs_grad = parts[i] if packed else kept.new_zeros(len(splats), 2)

    def fill(_: Tensor) -> None:
        for rows, (splats, _) in zip(kept.flatten(0, -3), projected, strict=True):
            assert splats.ids is not None
            assert splats.abs_grad is not None
            rows.index_copy_(0, splats.ids.long(), splats.abs_grad)

    if means2d.requires_grad and not packed:
        means2d.register_hook(fill)


def _items(tensor: Tensor, dims: int) -> list[Tensor]:
    """The items, which have `dims` dimensions, of a batch of any dimensions."""
    if tensor.dim() == dims:
        return [tensor]
    items = tensor.flatten(0, -dims - 1)
    # The gradient of one of several items is a copy.
    return [items.squeeze(0)] if len(items) == 1 else list(items.unbind(0))


def _stack_images(images: list[Tensor], of_views: tuple[int, ...]) -> Tensor:
    """Images (H, W, X) as one tensor (…, C, H, W, X); planar images stay planar."""
    if len(images) == 1:
        return images[0].reshape(*of_views, *images[0].shape)
    planes = torch.stack([image.permute(2, 0, 1) for image in images])
    return planes.permute(0, 2, 3, 1).unflatten(0, of_views)


def _meta(
    projected: list[tuple[Splats2D, Tensor]], packed: bool, of_views: tuple[int, ...], n: int
) -> tuple[dict[str, Any], Sequence[Tensor]]:
    """The intermediate results, and the centres of each view's splats, computed from them."""
    splats = [found for found, _ in projected]
    columns = {
        "means2d": [means2d for _, means2d in projected],
        "radii": [found.radii.ceil().int()[:, None].expand(-1, 2) for found in splats],
        "depths": [found.depths for found in splats],
        "conics": [found.conics for found in splats],
        "opacities": [found.opacities for found in splats],
    }
    rows = [found.ids.long() for found in splats if found.ids is not None]
    if packed:
        meta: dict[str, Any] = {name: _join_rows(parts) for name, parts in columns.items()}
        indices = [divmod(i, of_views[-1]) for i in range(len(rows))]
        for name, j in (("batch_ids", 0), ("camera_ids", 1)):
            of_rows = zip(rows, indices, strict=True)
            meta[name] = _join_rows(
                [own.new_full((), at[j]).expand(own.shape) for own, at in of_rows]
            )
        meta["gaussian_ids"] = _join_rows(rows)
        if len(rows) == 1:
            return meta, [meta["means2d"]]
        return meta, meta["means2d"].split([len(own) for own in rows])

    def every_row(parts: list[Tensor]) -> Tensor:
        dense = [
            part.new_zeros(n, *part.shape[1:]).index_copy(0, own, part)
            for part, own in zip(parts, rows, strict=True)
        ]
        return torch.stack(dense).unflatten(0, of_views)

    meta = {name: every_row(parts) for name, parts in columns.items()}
    meta |= dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    every = meta["means2d"].flatten(0, -3)
    return meta, [every[i, own] for i, own in enumerate(rows)]


def _join_rows(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)
