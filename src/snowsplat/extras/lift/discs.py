"""Flat Gaussians on a surface: each covers the part of the surface that its pixels see."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import quat_from_rotation, transform_points
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS

#: Standard deviation of the Gaussian of a pixel, in pixels. With smaller discs, dark gaps are
#: visible in a window that is larger than the photo. Larger discs blur other viewpoints.
SIGMA = 0.55
# The rasterizer adds this variance to each splat (Kerbl et al. 2023), in pixels squared.
_DILATION = 0.3
#: Opacity of a disc.
OPACITY = 0.99
# Thickness of a disc relative to its shorter axis.
_THICKNESS = 0.1


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
