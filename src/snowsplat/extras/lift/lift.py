"""`lift`: a photo and its depth map -> flat Gaussians with the colours of the photo."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from snowsplat.extras.lift.blocks import merge_pixels, pixel_blocks
from snowsplat.extras.lift.options import LiftOptions
from snowsplat.extras.lift.surface import find_links, snap_to_surfaces, surface_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, quat_from_rotation, transform_points
from snowsplat.scene.render import render
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS
from snowsplat.util.process import single_threaded

# More steps reproduce the photo better, but other viewpoints worse: the colours then compensate for
# each other at this pose only.
_STEPS = 10
#: Standard deviation of the Gaussian of a pixel, in pixels. With smaller discs, dark gaps are
#: visible in a window that is larger than the photo. Larger discs blur other viewpoints.
SIGMA = 0.55
# The rasterizer adds this variance to each splat (Kerbl et al. 2023), in pixels squared.
_DILATION = 0.3
#: Opacity of a disc.
OPACITY = 0.99
# Thickness of a disc relative to its shorter axis.
_THICKNESS = 0.1


def lift(
    photo: Tensor, depth: Tensor, camera: Camera, options: LiftOptions | None = None
) -> Gaussians:
    """The visible surface of a photo as flat Gaussians, in the world frame, of SH degree 0.

    Args:
        photo: (H, W, 3) float32 in 0..1.
        depth: (H, W) float32, camera z in world units, positive; NaN where it is unknown. There
            are no Gaussians for such pixels.
        camera: the camera of the photo, of size (W, H).

    Returns:
        The Gaussians in Morton order.

    Raises:
        ValueError: the sizes differ, or no depth is known.
    """
    options = options or LiftOptions()
    if photo.shape[:2] != depth.shape or (camera.height, camera.width) != depth.shape:
        raise ValueError(
            f"lift: the photo is {tuple(photo.shape[:2])}, the depth {tuple(depth.shape)}, the "
            f"camera {(camera.height, camera.width)}; they must be equal"
        )
    known = depth.isfinite() & (depth > 0)
    if not bool(known.any()):
        raise ValueError("lift: no pixel has a known depth")
    with single_threaded():
        return _lift(photo, torch.where(known, depth, torch.nan), camera, options)


def _lift(photo: Tensor, depth: Tensor, camera: Camera, options: LiftOptions) -> Gaussians:
    depth = snap_to_surfaces(depth, options.edge)
    known = depth.isfinite()
    links = find_links(depth, options.edge)
    surface = surface_of(depth, camera, links)
    if options.max_gaussians is None:
        blocks = pixel_blocks(known)
    else:
        blocks = merge_pixels(depth, photo, links, options.max_gaussians)
    gaussians = discs(
        blocks.mean(surface.points),
        blocks.mean(surface.tangents),
        blocks.mean(photo),
        camera,
        sigma=sigma_of_block(blocks.size),
    )
    # Pixels of unknown depth have no discs. Black, the background, leaves the others unchanged.
    known_photo = torch.where(known[..., None], photo, 0.0)
    gaussians = match_photo(gaussians, camera, known_photo)
    return gaussians.select(morton_order(gaussians.means))


def match_photo(gaussians: Gaussians, camera: Camera, photo: Tensor) -> Gaussians:
    """Gaussians with the same geometry and opacity, whose colours reproduce the photo.

    Discs of neighbouring pixels overlap, so an image of discs in the colours of the photo is
    blurred. For a fixed geometry, the image is linear in the colours: I = W c. This minimises
    ‖W c − photo‖² for c in 0..1, by projected gradient steps that are scaled by 1 / (Wᵀ 1), with
    Nesterov's momentum (Beck and Teboulle 2009). The backward pass of the rasterizer computes
    Wᵀ x. Gaussians that are not visible keep their colours.

    ``gaussians`` have the SH degree 0; ``photo`` (H, W, 3) is in 0..1.
    """
    colors = gaussians.base_colors.clamp(0.0, 1.0)
    # The scaling bounds the step by the mean of a row of Wᵀ W, which its largest row may exceed.
    weights = _transposed(gaussians, camera, torch.full_like(colors, 0.5), None).clamp_min(1e-3)
    ahead, momentum = colors, 1.0
    for _ in range(_STEPS):
        step = _transposed(gaussians, camera, ahead, photo) / weights
        following = (ahead + step).clamp(0.0, 1.0)
        grown = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * momentum * momentum))
        ahead = following + (momentum - 1.0) / grown * (following - colors)
        colors, momentum = following, grown
    return with_colors(gaussians, colors)


def with_colors(gaussians: Gaussians, colors: Tensor) -> Gaussians:
    """The Gaussians with the base colours (N, 3)."""
    return replace(gaussians, sh_dc=((colors - 0.5) / SH_C0)[:, None, :])


def _transposed(
    gaussians: Gaussians, camera: Camera, colors: Tensor, photo: Tensor | None
) -> Tensor:
    """(N, 3): Wᵀ (photo − W c), or Wᵀ 1 without a photo."""
    colors = colors.detach().requires_grad_()
    with torch.enable_grad():
        image = render(with_colors(gaussians, colors), camera).image
    residual = torch.ones_like(image) if photo is None else photo - image.detach()
    return torch.autograd.grad(image, colors, residual)[0]


def discs(
    points: Tensor,
    tangents: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    sigma: Tensor | float = SIGMA,
    opacity: Tensor | float = OPACITY,
) -> Gaussians:
    """A flat Gaussian for each point of a surface, of SH degree 0.

    Let J be the 3×2 matrix of the tangents, in world units per pixel. A circle in the
    image is the ellipse J x on the tangent plane, so the covariance is σ² J Jᵀ. Seen from the
    camera, every disc is a circle with the standard deviation σ. Its axes are the eigenvectors of
    this matrix, which follow from those of the 2×2 matrix JᵀJ. The third axis is the normal.

    Args:
        points: (N, 3) in the camera frame, in world units.
        tangents: (N, 3, 2) in the camera frame, in world units per pixel.
        colors: (N, 3) in 0..1.
        camera: its pose places the discs in the world frame.
        sigma: (N,) or a number, the standard deviation in the image, in pixels.
        opacity: (N,) or a number, in (0, 1).

    Returns: N Gaussians in the world frame; differentiable with respect to ``points``, ``colors``,
    ``sigma`` and ``opacity``.
    """
    axes, lengths = _axes(tangents)
    pose = camera.world_from_cam.to(points.dtype)
    rotations = pose[:, :3] @ axes
    sigma = torch.as_tensor(sigma, dtype=points.dtype).expand(len(points))
    opacity = torch.as_tensor(opacity, dtype=points.dtype).expand(len(points))
    return Gaussians(
        means=transform_points(pose, points),
        log_scales=lengths.log() + sigma.log()[:, None],
        quats=quat_from_rotation(rotations),
        opacity_logits=torch.logit(opacity).contiguous(),
        sh_dc=((colors - 0.5) / SH_C0)[:, None, :],
        sh_rest=points.new_zeros(len(points), SH_REST_COUNTS[0], 3),
    )


def _axes(tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (N, 3, 3), whose columns are the axes, and their lengths (N, 3), per pixel."""
    along_u, along_v = tangents.unbind(-1)
    a, b, c = ((x * y).sum(1) for x, y in ((along_u, along_u), (along_u, along_v), (along_v,) * 2))
    # JᵀJ = [[a, b], [b, c]]; the eigenvector of the larger eigenvalue is (cos θ, sin θ).
    theta = 0.5 * torch.atan2(2.0 * b, a - c)
    first = along_u * theta.cos()[:, None] + along_v * theta.sin()[:, None]
    longer = first.norm(dim=1)
    normal = torch.linalg.cross(along_u, along_v)
    area = normal.norm(dim=1)
    first, normal = first / longer[:, None], normal / area[:, None]
    shorter = area / longer  # det JᵀJ is the square of the area
    axes = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=2)
    return axes, torch.stack([longer, shorter, _THICKNESS * shorter], dim=1)


def sigma_of_block(size: Tensor) -> Tensor:
    """The standard deviations of the discs of square blocks of ``size`` (N,) ≥ 1 pixels, in pixels.

    After the rasterizer has added its variance, neighbouring discs of any size overlap as those of
    pixels do.
    """
    return ((SIGMA**2 + _DILATION) * size.square() - _DILATION).sqrt()
