"""3D Gaussian Splatting in plain PyTorch: the reference of every operation.

Names, arguments and results are those of `snowsplat.ops`. The functions work in any floating dtype
and are differentiable by autograd, but are much slower than the native kernels. Tests compare the
kernels with these functions in float64. From top to bottom, this file describes the method:

    project         3D Gaussians → 2D splats     x, Σ, W, J, Σ'      Kerbl et al. 2023, §4, eq. 4–6
    project_activated   the same, for scales, opacities and colours after their activations
    rasterize       2D splats → image            α, T, C             Kerbl et al. 2023, §6, eq. 2–3
    rasterize_median   the splat with T = ½
    count_blended   the number of blended splats per pixel
    photometric_loss, ssim                       L1, D-SSIM          Kerbl et al. 2023, eq. 7;
                                                                     Wang et al. 2004
    neighbours      the initial size             Kerbl et al. 2023, §5.1
    accumulate_screen_statistics                 for density control Kerbl et al. 2023, §5.2
    points_in_frusta   which views show a point  focal / z           Yu et al. 2024, §4.1
    points_in_spheres  which cameras are near it
    fuse_depth      signed distances             Σ w s / Σ w        Curless and Levoy 1996
    adam_step       one step of the optimiser    m, v                Kingma and Ba 2015
    add_noise       noise of the means           Σ η                 Kheradmand et al. 2024, eq. 8

`plane_sweep` is in `sweep_reference.py`.

- [Kerbl et al. 2023] 3D Gaussian Splatting for Real-Time Radiance Field Rendering. ACM TOG 42(4).
- [Zwicker et al. 2001] EWA Volume Splatting. IEEE Visualization. (The J and Σ' of `_project_rows`.)
- [Zwicker et al. 2002] EWA Splatting. IEEE TVCG 8(3). (The low-pass filter, here `LOW_PASS`.)
- [Yu et al. 2024] Mip-Splatting: Alias-free 3D Gaussian Splatting. CVPR. (`antialiased`.)

Coordinate frames are those of OpenCV: x right, y down, z forward. Pixel (i, j) has its centre at
(i + 0.5, j + 0.5).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from snowsplat.ops.adam import AdamRates, Moments
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.frusta import Frusta
from snowsplat.ops.gaussian_parameters import PARAMETERS, GaussianParameters, View
from snowsplat.ops.splats import SplatGradient, Splats2D
from snowsplat.ops.sweep_reference import plane_sweep as plane_sweep
from snowsplat.util.native_layout import TILE

LOW_PASS = 0.3  # pixels²: blurs every splat, so that it covers at least one pixel centre
MIP_LOW_PASS = 0.1  # pixels²: the same for antialiased scenes, about the area of a pixel
ALPHA_MIN = 1 / 255  # smaller contributions, below one level of an 8-bit image, are skipped
ALPHA_MAX = 0.99  # so that 1 − α, and with it the transmittance, is never 0
TRANSMITTANCE_MIN = 1e-4  # a splat that would make T lower, and those behind it, are not blended
JACOBIAN_MARGIN = 0.15  # fraction of the image size; J is clamped beyond this margin
QUAT_EPS = 1e-12

# Real spherical harmonics, by degree, with the sign convention of 3DGS scene files.
C0 = 0.28209479177387814  # ½ √(1/π)
C1 = 0.4886025119029199  # √(3/4π)
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


# ---------------------------------------------------------------------------------------- project


def project(gaussians: GaussianParameters, view: View) -> Splats2D:
    """Projects N Gaussians to splats on the image plane of a view, without the invisible ones.

    gaussians: means (N, 3) in world units; log_scales (N, 3); quats (N, 4) wxyz, not necessarily
    normalised (zero: no rotation); opacity_logits (N,); sh_dc (N, 1, 3); sh_rest (N, K, 3), whose
    first (view.sh_degree + 1)² − 1 rows are used. If `view.antialiased`, the low-pass filter does
    not change the integral of a splat.

    A Gaussian is visible if it lies beyond `view.near`, the opacity of its splat is ≥ 1/255, and
    the bounding box of its ellipse {α ≥ 1/255} overlaps the rectangle of the pixel centres. A
    Gaussian whose 2D covariance overflows the dtype is not visible.
    """
    parameters = [getattr(gaussians, name) for name in PARAMETERS]
    means, sh_rest = gaussians.means, gaussians.sh_rest
    if sh_rest.shape[1] < (view.sh_degree + 1) ** 2 - 1:
        raise ValueError(
            f"project: sh_rest has too few rows ({sh_rest.shape[1]}) for degree {view.sh_degree}"
        )
    pose = view.cam_from_world.to(means)
    with torch.no_grad():
        depths = means @ pose[2, :3] + pose[2, 3]
        ids = torch.nonzero(depths > view.near)[:, 0]
        splats, variances = _project_rows([p[ids] for p in parameters], pose, view)
        half_extent = _half_extents(variances, splats.opacities)
        last = torch.tensor([view.width - 0.5, view.height - 0.5]).to(means)
        touches = (splats.means2d + half_extent >= 0.5) & (splats.means2d - half_extent <= last)
        ids = ids[touches.all(dim=1)]  # comparisons with NaN are false: not visible
    # Computed again for the visible rows only: otherwise the other rows could give NaN gradients.
    splats, _ = _project_rows([p[ids] for p in parameters], pose, view)
    return Splats2D(splats.packed, ids.to(torch.int32), splats.channels)


def _project_rows(
    parameters: Sequence[Tensor],
    cam_from_world: Tensor,
    view: View,
    zoom: float | Tensor = 1.0,
) -> tuple[Splats2D, Tensor]:
    """Projects every row of `parameters` (in the order of `PARAMETERS`), visible or not.

    `cam_from_world` (3, 4) replaces the pose of the view; `zoom` multiplies both focal lengths.
    Also returns Σ'xx and Σ'yy (M, 2), NaN where det Σ' overflows.
    """
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = parameters
    W, t = cam_from_world[:, :3], cam_from_world[:, 3]  # (3, 3), (3,): the viewing transformation
    given = view.intrinsics
    numbers = [view.fx, view.fy, view.cx, view.cy] if given is None else given.tolist()
    fx, fy, (cx, cy) = zoom * numbers[0], zoom * numbers[1], numbers[2:]

    # The centre. (M, 3) in camera space, then (M, 2) in pixels.
    x, y, z = (means @ W.T + t).unbind(dim=1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    # Σ = R S Sᵀ Rᵀ (eq. 6), represented by its factor R S. (M, 3, 3)
    RS = _rotation_matrices(quats) * log_scales.exp()[:, None, :]

    # J, the affine approximation of the projection at the centre (Zwicker et al. 2001). It is
    # unbounded far outside of the image, so x/z and y/z are clamped to the image and a margin
    # around it. (M, 2, 3)
    x_margin, y_margin = JACOBIAN_MARGIN * view.width, JACOBIAN_MARGIN * view.height
    tx = (fx * x / z).clamp(-(cx + x_margin), view.width - cx + x_margin) / fx
    ty = (fy * y / z).clamp(-(cy + y_margin), view.height - cy + y_margin) / fy
    zero = torch.zeros_like(z)
    J_rows = [fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z]
    J = torch.stack(J_rows, dim=1).reshape(-1, 2, 3)

    # Σ' = J W Σ Wᵀ Jᵀ (eq. 5) plus the low-pass filter: Σ' = U Uᵀ + d I with U = J W R S.
    d = MIP_LOW_PASS if view.antialiased else LOW_PASS
    u0, u1 = (J @ W @ RS).unbind(dim=1)  # (M, 3) each
    xx, xy, yy = (u0 * u0).sum(dim=1), (u0 * u1).sum(dim=1), (u1 * u1).sum(dim=1)
    # det Σ' = |u0 × u1|² + d (xx + yy) + d². The formula xx·yy − xy² is inaccurate for thin splats.
    cross = torch.linalg.cross(u0, u1)
    undilated_det = (cross * cross).sum(dim=1)
    det = undilated_det + d * (xx + yy) + d**2
    xx, yy = xx + d, yy + d
    conics = torch.stack([yy / det, -xy / det, xx / det], dim=1)
    major = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)  # the larger eigenvalue of Σ'
    variances = torch.stack([xx, yy], dim=1)
    variances = torch.where(det.isfinite()[:, None], variances, torch.nan)

    # The view-dependent colour. The position of the camera in the world is −Wᵀ t.
    directions = means + W.T @ t
    directions = directions / directions.norm(dim=1, keepdim=True)
    count = (view.sh_degree + 1) ** 2
    coefficients = torch.cat([sh_dc, sh_rest], dim=1)[:, :count]  # (M, count, 3)
    basis = sh_basis(directions, view.sh_degree)  # (M, count)
    colors = (0.5 + (basis[:, :, None] * coefficients).sum(dim=1)).clamp(min=0)

    # The 2D mip filter (Yu et al. 2024, eq. 10): the low-pass filter keeps the splat's integral.
    opacities = torch.sigmoid(opacity_logits)
    if view.antialiased:
        opacities = opacities * (undilated_det / det).sqrt()
    radii = 3 * major.detach().sqrt()
    return Splats2D.pack(means2d, conics, opacities, z, colors, radii), variances


def _rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations (M, 3, 3) of quaternions (M, 4) wxyz of any length. Zero: the identity."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True).clamp(min=QUAT_EPS)).unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)  # (M, 3, 3)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics, degrees 0 to `degree` ≤ 3, at unit directions (M, 3).

    Returns (M, (degree + 1)²).
    """
    x, y, z = directions.unbind(dim=1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        basis += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=1)


def _half_extents(variances: Tensor, opacities: Tensor) -> Tensor:
    """Half width and height, (M, 2) pixels, of the bounding box of {α ≥ 1/255}; NaN if it is empty.

    o exp(−½ dᵀ Σ'⁻¹ d) = 1/255 is equivalent to dᵀ Σ'⁻¹ d = 2 ln(255 o). This is an ellipse; its
    half width is √(2 ln(255 o) Σ'xx).
    """
    return (2 * torch.log(opacities / ALPHA_MIN)[:, None] * variances).sqrt()


@torch.no_grad()
def add_project_gradients(
    gaussians: GaussianParameters,
    grads: Mapping[str, Tensor],
    gradient: SplatGradient,
    view: View,
) -> None:
    """Propagates the gradient of splats through `project`, and adds the result to ``grads``.

    `gaussians` and `view` are those of `project`; `grads` are tensors of the names and shapes of
    the six parameters, changed in place; `gradient` is that of the splats.
    """
    assert gradient.packed is not None
    rows = gradient.ids.long()
    with torch.enable_grad():
        selected = [getattr(gaussians, name).detach()[rows].requires_grad_() for name in PARAMETERS]
        splats, _ = _project_rows(selected, view.cam_from_world.to(gradient.packed), view)
        of_rows = torch.autograd.grad(splats.packed, selected, gradient.packed)
    for name, grad in zip(PARAMETERS, of_rows, strict=True):
        grads[name][rows] += grad


@torch.no_grad()
def camera_gradient(
    gaussians: GaussianParameters, gradient: SplatGradient, view: View
) -> tuple[Tensor, Tensor]:
    """Propagates the gradient of splats through `project` to the camera.

    The arguments are those of `add_project_gradients`. Returns the gradients with respect to
    `view.cam_from_world`, (3, 4), and to the logarithm of a factor of fx and fy, ().
    """
    assert gradient.packed is not None
    with torch.enable_grad():
        pose = view.cam_from_world.to(gradient.packed, copy=True).requires_grad_()
        zoom = pose.new_ones((), requires_grad=True)
        rows = gradient.ids.long()
        selected = [getattr(gaussians, name).detach()[rows] for name in PARAMETERS]
        splats, _ = _project_rows(selected, pose, view, zoom)
        # At the zoom 1, the derivative by the zoom is that by its logarithm.
        d_pose, d_zoom = torch.autograd.grad(splats.packed, (pose, zoom), gradient.packed)
    return d_pose, d_zoom


def project_activated(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colors: Tensor,
    view: View,
    *,
    far: float = 1e10,
    radius_clip: float = 0.0,
) -> tuple[Splats2D, Tensor]:
    """`project` of scales (N, 3), opacities (N,) and colours after their activations.

    colors are (N, C), any numbers, or (N, K, 3) coefficients of spherical harmonics. Splats of a
    depth beyond `far`, or of a radius up to `radius_clip`, are removed. Also returns the centres of
    the splats (M, 2).
    """
    harmonics = colors.dim() == 3
    constants = colors[:, :1] if harmonics else torch.zeros_like(means)[:, None]
    rest = colors[:, 1:] if harmonics else means.new_zeros(len(means), 0, 3)
    logits = torch.logit(opacities, eps=1e-15)
    gaussians = SimpleNamespace(
        means=means,
        log_scales=scales.log(),
        quats=quats,
        opacity_logits=logits,
        sh_dc=constants,
        sh_rest=rest,
    )
    splats = project(gaussians, view if harmonics else replace(view, sh_degree=0))
    assert splats.ids is not None
    kept = (splats.depths <= far) & (splats.radii > radius_clip)
    packed, ids = splats.packed[kept], splats.ids[kept]
    splats = Splats2D(packed, ids, 3)
    if not harmonics:
        s = splats
        splats = Splats2D.pack(
            s.means2d, s.conics, s.opacities, s.depths, colors[ids.long()], s.radii, ids
        )
    return splats, splats.means2d


# -------------------------------------------------------------------------------------- rasterize


def rasterize(
    splats: Splats2D,
    width: int,
    height: int,
    background: Tensor | None = None,
    *,
    with_depth: bool = False,
    additive: bool = False,
    capacity: Capacity | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Composites splats over `background` (C,), which is black by default.

    The nearest splat is first; splats of equal depth are in the order of their rows. Returns image
    (H, W, C) with planar storage, alpha (H, W), and depth (H, W) or None:
    image = Σ T α c + T_end · background, alpha = 1 − T_end, depth = Σ T α z (not divided by alpha),
    where T is the transmittance of the splats in front. Conics must be positive definite. If
    `additive`, α is not limited to 0.99, T stays 1, and so alpha is 0 (Zhang et al. 2024).
    `capacity` is ignored, because the memory always suffices. If `splats.abs_grad` is not None, the
    backward pass adds, for each 16×16 tile, the absolute value of the gradient of `means2d` that
    comes from the pixels of the tile.
    """
    order, abs_grad = torch.argsort(splats.depths.detach(), stable=True), splats.abs_grad
    splats = Splats2D(splats.packed[order], None, splats.channels)
    means2d, conics, opacities = splats.means2d, splats.conics, splats.opacities
    values = splats.colors
    if with_depth:
        values = torch.cat([values, splats.depths[:, None]], dim=1)
    if background is None:
        background = values.new_zeros(splats.channels)
    with torch.no_grad():
        a, b, c = conics.unbind(dim=1)
        variances = torch.stack([c, a], dim=1) / (a * c - b * b)[:, None]  # Σ'xx, Σ'yy
        half_extent = _half_extents(variances, opacities).nan_to_num(nan=torch.inf)
        # With a margin of 1e-3, because of rounding.
        low, high = means2d - half_extent - 1e-3, means2d + half_extent + 1e-3

    bands = []
    for top in range(0, height, TILE):
        tiles = []
        for left in range(0, width, TILE):
            h, w = min(TILE, height - top), min(TILE, width - left)
            first = torch.tensor([left + 0.5, top + 0.5]).to(means2d)
            last = torch.tensor([left + w - 0.5, top + h - 0.5]).to(means2d)
            tile = ((high >= first) & (low <= last)).all(dim=1).nonzero()[:, 0]
            pixels = _pixel_centres(left, top, w, h).to(means2d)  # (P, 2)
            means = means2d[tile]
            if abs_grad is not None and means.requires_grad:
                means.register_hook(_adds_absolute_values(abs_grad, order[tile]))
            geometry = (pixels, means, conics[tile], opacities[tile])
            alpha, T, T_end = (_additive_weights if additive else _blend_weights)(*geometry)
            blended = (T * alpha) @ values[tile]  # (P, C or C + 1)
            tiles.append(torch.cat([blended, T_end], dim=1).T.reshape(-1, h, w))
        bands.append(torch.cat(tiles, dim=2))
    planes = torch.cat(bands, dim=1)  # (C or C + 1, and T_end; H, W)

    channels, T_end = splats.channels, planes[-1]
    image = planes[:channels] + T_end * background[:, None, None]
    depth = planes[channels] if with_depth else None
    return image.permute(1, 2, 0), 1 - T_end, depth


def _adds_absolute_values(abs_grad: Tensor, rows: Tensor) -> Callable[[Tensor], None]:
    """A hook that adds |gradient| (K, 2) of some splats to their rows of `abs_grad` (M, 2)."""

    def add(grad: Tensor) -> None:
        abs_grad.index_add_(0, rows, grad.abs())

    return add


@torch.no_grad()
def rasterize_median(splats: Splats2D, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """The colours (H, W, C) of the last blended splat with T ≥ ½, their blend, and alpha."""
    order = torch.argsort(splats.depths, stable=True)
    means2d, conics, opacities, colors = (
        values[order] for values in (splats.means2d, splats.conics, splats.opacities, splats.colors)
    )
    rows = []
    for y in range(height):
        pixels = _pixel_centres(0, y, width, 1).to(means2d)
        alpha, T, _ = _blend_weights(pixels, means2d, conics, opacities)
        chosen = (alpha > 0) & (T >= 0.5)
        number = chosen * torch.arange(1, len(order) + 1)
        last = torch.cat([number.new_zeros(width, 1), number], 1).amax(1)
        rows.append(torch.cat([colors.new_zeros(1, splats.channels), colors])[last])
    mean, alpha, _ = rasterize(splats, width, height)
    return torch.stack(rows), mean, alpha


def count_blended(splats: Splats2D, width: int, height: int) -> Tensor:
    """(H, W): the number of splats that `rasterize` blends into each pixel."""
    order = torch.argsort(splats.depths.detach(), stable=True)
    means2d, conics, opacities = (
        values[order] for values in (splats.means2d, splats.conics, splats.opacities)
    )
    rows = []
    for y in range(height):
        pixels = _pixel_centres(0, y, width, 1).to(means2d)
        alpha, _, _ = _blend_weights(pixels, means2d, conics, opacities)
        rows.append((alpha > 0).sum(1).to(means2d))
    return torch.stack(rows)


def _pixel_centres(left: int, top: int, width: int, height: int) -> Tensor:
    """The pixel centres (width · height, 2), row by row, of a block with this left top corner."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x + left, y + top], dim=2).reshape(-1, 2) + 0.5


def _blend_weights(
    pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """For P pixels and M sorted splats: α (P, M), T before each splat (P, M), and T_end (P, 1).

    α is 0 if a splat is not blended.
    """
    alpha = _falloffs(pixels, means2d, conics, opacities).clamp(max=ALPHA_MAX)
    # T decreases. The first splat that would make T too small, and all splats behind it, are not
    # blended.
    unfinished = torch.cumprod(1 - alpha, dim=1) >= TRANSMITTANCE_MIN
    alpha = torch.where(unfinished, alpha, 0)
    ones = alpha.new_ones(len(pixels), 1)
    T = torch.cat([ones, torch.cumprod(1 - alpha, dim=1)], dim=1)  # (P, M + 1)
    return alpha, T[:, :-1], T[:, -1:]


def _additive_weights(
    pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The same for additive blending: the weights (P, M), and T = 1 everywhere."""
    weights = _falloffs(pixels, means2d, conics, opacities)
    return weights, torch.ones_like(weights), weights.new_ones(len(pixels), 1)


def _falloffs(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """(P, M): o exp(−½ dᵀ conic d), or 0 where this is less than 1/255."""
    dx, dy = (pixels[:, None, :] - means2d).unbind(dim=2)  # (P, M) each
    a, b, c = conics.unbind(dim=1)
    alpha = opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    return torch.where(alpha < ALPHA_MIN, 0, alpha)


# ----------------------------------------------------------------------------------- photometric


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004) of images (H, W, C) in [0, 1]: 1 if they are equal.

    The 11 × 11 Gaussian window with σ = 1.5 sums to 1; the image is padded with zeros. Returns
    the mean over all pixels and channels, a scalar.
    """
    channels = image.shape[2]
    offsets = torch.arange(11, dtype=image.dtype, device=image.device) - 5
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = window / window.sum()
    kernel = torch.outer(window, window).expand(channels, 1, 11, 11)

    def local_mean(values: Tensor) -> Tensor:
        return conv2d(values[None], kernel, padding=5, groups=channels)[0]

    a, b = image.permute(2, 0, 1), _as_unit(target, image).permute(2, 0, 1)  # (C, H, W)
    mean_a, mean_b = local_mean(a), local_mean(b)
    var_a = local_mean(a * a) - mean_a * mean_a
    var_b = local_mean(b * b) - mean_b * mean_b
    covariance = local_mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    structure = (2 * covariance + c2) / (var_a + var_b + c2)
    return (luminance * structure).mean()


def photometric_loss(
    image: Tensor, target: Tensor, ssim_weight: float = 0.2, huber_weight: float = 0.0
) -> Tensor:
    """(1 − λ) · mean |image − target| + λ · (1 − SSIM), eq. 7 with λ = `ssim_weight`: a scalar.

    `huber_weight` times the mean of the Huber function with δ = 0.1 is added.
    image (H, W, C) in [0, 1]; target of the same shape, floating in [0, 1] or uint8.
    """
    size = (image - _as_unit(target, image)).abs()
    near = size.clamp(max=0.1)
    huber = (near * (2 * size - near)).mean()
    l1 = (1 - ssim_weight) * size.mean()
    return l1 + ssim_weight * (1 - ssim(image, target)) + huber_weight * huber


def _as_unit(target: Tensor, like: Tensor) -> Tensor:
    """The image in the dtype of `like`. The values of an 8-bit image are divided by 255."""
    return target.to(like) / 255 if target.dtype == torch.uint8 else target.to(like)


# ------------------------------------------------------------------------------------ neighbours


def neighbours(points: Tensor, k: int = 3) -> Tensor:
    """Distances (N, k), ascending, from each of points (N, 3) to its k nearest other points.

    Another point with the same coordinates counts, with distance 0. If there are fewer than k other
    points, the remaining distances are inf.
    """
    count = len(points)
    found = points.new_full((count, k), torch.inf)
    available = min(k, count - 1)
    for start in range(0, count, 1024):
        chunk = points[start : start + 1024]
        distances = torch.cdist(chunk, points, compute_mode="donot_use_mm_for_euclid_dist")
        rows = torch.arange(len(chunk))
        distances[rows, rows + start] = torch.inf  # not the point itself
        found[start : start + 1024, :available] = distances.topk(available, largest=False).values
    return found


# ------------------------------------------------------------------------------ points_in_frusta


@torch.no_grad()
def points_in_frusta(points: Tensor, frusta: Frusta) -> tuple[Tensor, Tensor]:
    """The number (N,) of frusta that contain each of points (N, 3), and the largest sampling rate.

    A point at depth z is sampled with focal / z pixels per world unit (Yu et al. 2024, eq. 6).
    """
    at = torch.einsum("vij,nj->nvi", frusta.to_image[:, :, :3], points) + frusta.to_image[..., 3]
    depth = at[..., 2]
    inside = (depth > frusta.depths[:, 0]) & (depth < frusta.depths[:, 1])
    inside &= (at[..., :2] >= 0).all(-1) & (at[..., :2] < frusta.size * depth[..., None]).all(-1)
    rates = torch.where(inside, frusta.focal / depth, 0.0)
    nothing = rates.new_zeros(len(points), 1)
    return inside.sum(1).to(points.dtype), torch.cat([rates, nothing], 1).amax(1)


@torch.no_grad()
def points_in_spheres(points: Tensor, spheres: Tensor) -> tuple[Tensor, Tensor]:
    """The number (N,) of spheres (C, 4), a centre and a radius, that contain each of points (N, 3),
    and the distance (N,) of the nearest centre."""
    distances = (points[:, None] - spheres[:, :3]).norm(dim=2)
    nothing = distances.new_full((len(points), 1), math.inf)
    inside = (distances < spheres[:, 3]).sum(1)
    return inside.to(points.dtype), torch.cat([distances, nothing], 1).amin(1)


# ------------------------------------------------------------------------------------ fuse_depth


@torch.no_grad()
def fuse_depth(
    sums: Tensor,
    origins: Tensor,
    spacing: float,
    to_image: Tensor,
    depth: Tensor,
    weight: Tensor,
    truncation: float,
    image: Tensor | None = None,
) -> None:
    """Adds (w, w s, w c) to the sums of samples in cubes, where s = min((d − z) / truncation, 1).

    w is reduced linearly behind the surface. With an image, only samples with s < 1 count.
    """
    side, (height, width) = sums.shape[1], depth.shape
    along = torch.arange(side, dtype=sums.dtype) * spacing
    z, y, x = torch.meshgrid(along, along, along, indexing="ij")
    points = (origins[:, None] + torch.stack([x, y, z], 3).reshape(-1, 3)).reshape(-1, 3)
    at = points @ to_image[:, :3].T + to_image[:, 3]
    z = at[:, 2]
    size = at.new_tensor([width, height])
    uv = at[:, :2] / z[:, None]
    (rows,) = ((z > 0) & (uv >= 0).all(1) & (uv < size).all(1)).nonzero(as_tuple=True)
    z, uv = z[rows], uv[rows]
    column, row = uv.floor().long().unbind(1)
    left, top = (uv - 0.5).floor().long().unbind(1)
    inner = (left >= 0) & (top >= 0) & (left + 1 < width) & (top + 1 < height)
    fx, fy = (uv - 0.5 - torch.stack([left, top], 1)).unbind(1)
    left, top = left.clamp(0, max(0, width - 2)), top.clamp(0, max(0, height - 2))
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)

    def corners(values: Tensor) -> Tensor:
        return torch.stack(
            [values[top, left], values[top, right], values[bottom, left], values[bottom, right]]
        )

    def interpolated(values: Tensor, where: Tensor) -> Tensor:
        a, b, c, d = corners(values)
        above, below = a + fx * (b - a), c + fx * (d - c)
        return torch.where(where, above + fy * (below - above), values[row, column])

    around = corners(depth)
    smooth = inner & (around > 0).all(0) & (around.amax(0) - around.amin(0) < truncation)
    known = (weight[row, column] > 0) & (depth[row, column] > 0)
    known &= z - depth[row, column] < truncation
    s = (interpolated(depth, smooth) - z) / truncation
    known &= (s > -1) & ((s < 1) | (image is None))
    s = s.clamp(max=1.0)
    w = weight[row, column] * (1 + s).clamp(max=1.0)
    parts = [w, w * s, *(w * interpolated(c, inner) for c in ([] if image is None else image))]
    flat = sums.view(-1, sums.shape[-1])
    flat[rows[known]] += torch.stack(parts, 1)[known]


# ------------------------------------------------------------------ accumulate_screen_statistics


@torch.no_grad()
def accumulate_screen_statistics(
    splats: Splats2D,
    width: int,
    height: int,
    norm_sum: Tensor,
    views: Tensor,
    max_radii: Tensor | None = None,
    valid: Tensor | None = None,
    *,
    absolute: bool = False,
) -> None:
    """Adds one view to the statistics of the visible Gaussians for density control (section 5.2).

    The gradient of the 2D mean, (M, 2), is scaled to a screen that spans [-1, 1] in x and y. Rows
    with a non-finite gradient are skipped. If `valid` (1,) is False, all rows are skipped. If
    `absolute`, `splats.abs_grad` is used instead of the gradient.
    """
    if valid is not None and not valid:
        return
    assert splats.ids is not None
    grad = splats.abs_grad if absolute else splats.packed.grad
    assert grad is not None
    norms = (grad[:, :2] * norm_sum.new_tensor([width / 2, height / 2])).norm(dim=1)
    counts = norms.isfinite()
    rows = splats.ids.long()[counts]
    norm_sum[rows] += norms[counts]
    views[rows] += 1
    if max_radii is not None:
        max_radii[rows] = torch.maximum(max_radii[rows], splats.radii[counts])


# ------------------------------------------------------------------------------------- adam_step


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

    The arguments are those of `snowsplat.ops.adam_step`.

    Rows of sh_rest beyond `view.sh_degree` keep their values and moments. The step is
    p −= lr · m̂ / √(v̂ + eps²); the paper has the denominator √v̂ + eps. The steps with
    these two denominators agree for v̂ ≫ eps² and for m̂ = v̂ = 0. √(v̂ + eps²) is used because it
    needs only one reciprocal square root.
    """
    if valid is not None and not valid:
        return
    params = {name: getattr(gaussians, name) for name in PARAMETERS}
    grads = {name: torch.zeros_like(p) for name, p in params.items()}
    if gradient.packed is not None:
        add_project_gradients(gaussians, grads, gradient, view)

    beta1, beta2 = rates.betas
    for i, (name, grad) in enumerate(grads.items()):
        p, exp_avg, exp_avg_sq = params[name], moments.exp_avg[name], moments.exp_avg_sq[name]
        if p.grad is not None:
            grad += p.grad
        m = beta1 * exp_avg + (1 - beta1) * grad
        v = beta2 * exp_avg_sq + (1 - beta2) * grad * grad
        m_hat, v_hat = m / (1 - beta1**rates.step), v / (1 - beta2**rates.step)
        new_value = p - rates.lr[name] * m_hat / (v_hat + rates.eps**2).sqrt()

        updated = torch.ones_like(p, dtype=torch.bool)
        if visible_only:
            updated[:] = False
            updated[gradient.ids.long()] = True
        if name == "sh_rest":
            updated[:, (view.sh_degree + 1) ** 2 - 1 :] = False
        nonfinite = updated & ~(v.isfinite() & new_value.isfinite())
        if nonfinite_rows is not None:
            by_row = nonfinite.reshape(len(p), -1) if p.numel() else nonfinite.new_zeros(0, 1)
            nonfinite_rows[i] += by_row.any(dim=1).sum()
        updated &= ~nonfinite
        p.copy_(torch.where(updated, new_value, p))
        exp_avg.copy_(torch.where(updated, m, exp_avg))
        exp_avg_sq.copy_(torch.where(updated, v, exp_avg_sq))


# ------------------------------------------------------------------------------------- add_noise


@torch.no_grad()
def add_noise(
    gaussians: GaussianParameters,
    amount: float,
    *,
    sharpness: float,
    opacity: float,
    negligible: float,
    seed: int,
    first: int = 0,
) -> None:
    """μ += amount · σ(k (t − o)) · Σ η, in place, with η ~ N(0, I) (Kheradmand et al. 2024, eq. 8).

    The random bits are those of Philox 4x32-10 (Salmon et al. 2011).
    """
    means = gaussians.means
    gate = torch.sigmoid(sharpness * (opacity - torch.sigmoid(gaussians.opacity_logits)))
    eta = normal_numbers(seed, first, len(means)).to(means)
    rotation = _rotation_matrices(gaussians.quats)
    variances = (2 * gaussians.log_scales).clamp(max=40).exp()
    noise = torch.einsum("nik,nk,njk,nj->ni", rotation, variances, rotation, eta)
    moved = means + amount * gate[:, None] * noise
    used = (gate > negligible) & moved.isfinite().all(1)
    means[used] = moved[used]


def normal_numbers(seed: int, first: int, count: int) -> Tensor:
    """(count, 3) float64 of N(0, 1): those with the numbers from ``first`` on (Box and Muller)."""
    a, b, c, d = random_bits(seed, torch.arange(first, first + count)).double().unbind(1)
    radius = (-2 * ((torch.stack([a, c], 1) + 0.5) / 2**32).log()).sqrt()
    angle = 2 * math.pi * torch.stack([b, d], 1) / 2**32
    return torch.stack([radius * angle.cos(), radius * angle.sin()], 2).flatten(1)[:, :3]


def random_bits(seed: int, counters: Tensor) -> Tensor:
    """(N, 4) int64 of 32 random bits for each of counters (N,) int64: Philox 4x32-10."""
    low = 0xFFFFFFFF
    zero = torch.zeros_like(counters)
    a, b, c, d = counters & low, counters >> 32, zero, zero
    key = [seed & low, seed >> 32]
    for _ in range(10):
        first, second = 0xD2511F53 * a, 0xCD9E8D57 * c  # of 64 bits, as if without sign
        a, c = (second >> 32 & low) ^ b ^ key[0], (first >> 32 & low) ^ d ^ key[1]
        b, d = second & low, first & low
        key = [(key[0] + 0x9E3779B9) & low, (key[1] + 0xBB67AE85) & low]
    return torch.stack([a, b, c, d], 1)
