"""`rasterization`: the call of gsplat, on a CPU as well as on a GPU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from snowsplat.ops.activated import project_activated, with_centres
from snowsplat.ops.rasterizer import rasterize
from snowsplat.ops.splats import Splats2D
from snowsplat.ops.view import View
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import TILE

#: eps2d of each `rasterize_mode`: the low-pass filters of the kernels.
_EPS2D = {"classic": 0.3, "antialiased": 0.1}
_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
#: The value of each argument of gsplat that has only one here, and what to do.
_FIXED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "gradients are dense; leave it out"),
    "absgrad": (False, "use the gradient of meta['means2d'], or `ops.Splats2D.abs_grad`"),
    "distributed": (False, "train in several processes with `snowsplat train --processes`"),
    "camera_model": ("pinhole", "undistort the photos, and use pinhole cameras"),
    "segmented": (False, "the sort has one implementation; leave it out"),
    "covars": (None, "pass quats and scales"),
    "with_ut": (False, "leave it out, and use pinhole cameras"),
    "with_eval3d": (False, "leave it out, and use pinhole cameras"),
    "radial_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "tangential_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "thin_prism_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "ftheta_coeffs": (None, "undistort the photos, and use pinhole cameras"),
    "rolling_shutter": (None, "use photos of a global shutter"),
    "viewmats_rs": (None, "use photos of a global shutter"),
}


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
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
    tile_size: int = TILE,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras: the arguments and results of `gsplat.rasterization`.

    A script that calls gsplat runs on a CPU (or on a GPU, if its tensors are there) after one
    changed import: ``from snowsplat import rasterization``. All tensors are float32, or all are
    float64, and on one device. "…" are batch dimensions, or none.

    Args:
        means: (…, N, 3) in world units.
        quats: (…, N, 4) wxyz, not necessarily normalised.
        scales: (…, N, 3) standard deviations, at least 0, in world units.
        opacities: (…, N), in [0, 1].
        colors: without `sh_degree`, (…, N, D) or (…, C, N, D): colours or features, any numbers.
            With `sh_degree`, (…, N, K, 3) or (…, C, N, K, 3): coefficients of spherical harmonics,
            K ≥ (sh_degree + 1)².
        viewmats: (…, C, 4, 4) from the world to the camera, with the axes of OpenCV.
        Ks: (…, C, 3, 3) intrinsics, in pixels, without skew. They get no gradient.
        width, height: of the images, in pixels.
        near_plane, far_plane: Gaussians with a depth outside of these limits are not visible.
        radius_clip: Gaussians with a radius up to this one, in pixels, are not visible. The radius
            is 3 σ of the major axis.
        eps2d: must be 0.3 for "classic" and 0.1 for "antialiased": the kernels have no others.
        sh_degree: None, or 0 to 3.
        packed: whether `meta` has rows of the visible Gaussians only. The images are the same.
        tile_size, channel_chunk: accepted for compatibility; they change nothing.
        backgrounds: (…, C, D); None is black. Depths have the background 0.
        render_mode: "RGB", "D" (depth Σ T α z), "ED" (expected depth: D / alpha), "RGB+D" or
            "RGB+ED". "RGB" are the colours or features.
        rasterize_mode: "classic"; or "antialiased", which is the 2D mip filter.
        others: the other arguments of gsplat; only their defaults are possible.

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
        "tile_height", "n_batches" and "n_cameras", but not the lists of intersections.

    Gradients flow to means, quats, scales, opacities, colors, viewmats and backgrounds.

    Differences from gsplat: α is at most 0.99, not 0.999. The position of a camera, for the viewing
    directions, is −Rᵀ t instead of that of the inverse matrix, so the gradients of viewmats agree
    for rigid motions, not for other changes of the matrix. A Gaussian is drawn wherever α ≥ 1/255;
    gsplat draws it in the tiles of a box whose half widths are rounded up to pixels, which is at
    least as large.

    Raises:
        UserError: an argument has a value that gsplat supports and snowsplat does not.
        ValueError: shapes, dtypes or devices do not match.
    """
    _refuse_unsupported(
        {"sparse_grad": sparse_grad, "absgrad": absgrad, **others},
        eps2d,
        sh_degree,
        render_mode,
        rasterize_mode,
    )
    *batch, n, _ = means.shape
    if viewmats.dim() != len(batch) + 3:
        what = f"viewmats must be {(*batch, 'C', 4, 4)}, got {tuple(viewmats.shape)}"
        raise ValueError(f"rasterization: {what}; for one camera, C is 1: viewmats[None]")
    of_views = (*batch, *viewmats.shape[-3:-2])
    row: tuple[int, ...] = colors.shape[-1:] if sh_degree is None else colors.shape[-2:]
    per_camera = colors.dim() - len(row) == len(batch) + 2
    for name, tensor, shape in (
        ("quats", quats, (*batch, n, 4)),
        ("scales", scales, (*batch, n, 3)),
        ("opacities", opacities, (*batch, n)),
        ("colors", colors, (*(of_views if per_camera else batch), n, *row)),
        ("viewmats", viewmats, (*of_views, 4, 4)),
        ("Ks", Ks, (*of_views, 3, 3)),
        ("backgrounds", backgrounds, (*of_views, row[-1])),
    ):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"rasterization: {name} must be {shape}, got {tuple(tensor.shape)}")

    with_colors, with_depth = render_mode.startswith("RGB"), render_mode != "RGB"
    if not with_colors:  # a depth needs no colours; one feature is the cheapest
        colors, row, per_camera, backgrounds = means[..., :1].detach(), (1,), False, None
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
            antialiased=rasterize_mode == "antialiased",
        )
        b = i // cameras
        projected.append(
            project_activated(
                each_means[b],
                each_scales[b],
                each_quats[b],
                each_opacities[b],
                each_colors[i if per_camera else b],
                view,
                far=far_plane,
                radius_clip=radius_clip,
            )
        )
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

    images, alphas = [], []
    behind = [None] * len(projected) if backgrounds is None else _items(backgrounds, 1)
    for (splats, _), means2d, background in zip(projected, centres, behind, strict=True):
        splats = with_centres(splats, means2d)
        image, alpha, depth = rasterize(splats, width, height, background, with_depth=with_depth)
        if depth is not None:
            if render_mode.endswith("ED"):
                depth = depth / alpha.clamp(min=1e-10)
            depth = depth[..., None]
            image = torch.cat([image, depth], dim=2) if with_colors else depth
        images.append(image)
        alphas.append(alpha[..., None])
    return _stack_images(images, of_views), _stack_images(alphas, of_views), meta


def _refuse_unsupported(
    given: dict[str, Any],
    eps2d: float,
    sh_degree: int | None,
    render_mode: str,
    rasterize_mode: str,
) -> None:
    for name, value in given.items():
        if name not in _FIXED:
            raise TypeError(f"rasterization: there is no argument {name}")
        only, remedy = _FIXED[name]
        if value is not only and value != only:
            raise UserError(
                "rasterization: {name} is not supported; {remedy}", name=name, remedy=remedy
            )
    if render_mode not in _RENDER_MODES:
        what = f"render_mode={render_mode!r} is not supported; use {', '.join(_RENDER_MODES)}"
        raise UserError("rasterization: {what}", what=what)
    if rasterize_mode not in _EPS2D:
        what = f"rasterize_mode={rasterize_mode!r} is not supported; use {' or '.join(_EPS2D)}"
        raise UserError("rasterization: {what}", what=what)
    if eps2d != _EPS2D[rasterize_mode]:
        raise UserError(
            "rasterization: eps2d={eps2d:g} is not supported with "
            "rasterize_mode={rasterize_mode!r}; use eps2d={eps2d2:g}",
            eps2d=eps2d,
            rasterize_mode=rasterize_mode,
            eps2d2=_EPS2D[rasterize_mode],
        )
    if sh_degree is not None and not 0 <= sh_degree <= 3:
        raise UserError(
            "rasterization: sh_degree={sh_degree} is not supported; use 0 to 3", sh_degree=sh_degree
        )


def _items(tensor: Tensor, dims: int) -> list[Tensor]:
    """The items, which have `dims` dimensions, of a batch of any dimensions."""
    if tensor.dim() == dims:
        return [tensor]
    items = tensor.reshape(-1, *tensor.shape[tensor.dim() - dims :])
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
    every = meta["means2d"].reshape(-1, n, 2)
    return meta, [every[i, own] for i, own in enumerate(rows)]


def _join_rows(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)
