"""Where a scene is, for datasets that come without points (and a sober box for those with)."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.scene.camera import Camera

#: The cube's half side, as a share of what the median camera sees at the distance of its centre.
#: With it the synthetic Blender scenes get ±1.3, the cube in which they are known to lie.
_SHARE_OF_VIEW = 0.9


def scene_bounds(cameras: Sequence[Camera], points: Tensor | None = None) -> Tensor:
    """Low and high corner (2, 3) float32 of an axis-aligned box of the scene, world frame.

    With points: the box of them without the outermost 1% at each side.

    Without: a cube about the point nearest to all optical axes (least squares), as large as the
    median camera sees there. Two kinds of dataset have no such point. Cameras that look the same
    way: the cube is set in front of them, five extents away, which is a guess, since nothing
    tells the distance. Cameras that look apart, from within: the cube is set around them, five
    extents to each side.

    Raises:
        ValueError: no cameras.
    """
    if not cameras:
        raise ValueError("scene_bounds needs a camera")
    if points is not None and len(points) >= 100:
        low, high = np.quantile(points.detach().cpu().numpy(), (0.01, 0.99), axis=0)
        return torch.from_numpy(np.stack([low, high])).to(torch.float32)

    centres = torch.stack([camera.position.detach().to(torch.float64) for camera in cameras])
    axes = torch.stack(
        [camera.cam_from_world.detach()[2, :3].to(torch.float64) for camera in cameras]
    )
    tangent = torch.tensor([_half_view(camera) for camera in cameras]).median()
    middle = centres.mean(0)
    spread = float((centres - middle).norm(dim=1).max()) or 1.0

    # Minimise the sum over cameras of |(I − d dᵀ)(p − c)|². Its matrix is singular along a
    # direction that all axes share; 1e-3 is axes within about two degrees of each other.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(0)
    if float(torch.linalg.eigvalsh(system)[0]) > 1e-3:
        centre = torch.linalg.solve(system, (across @ centres[:, :, None]).mean(0)[:, 0])
        depths = ((centre - centres) * axes).sum(1)
        if float((depths > 0).double().mean()) > 0.5:
            half = _SHARE_OF_VIEW * float(depths.median() * tangent)
            return _cube(centre, half)

    direction = axes.mean(0)
    if float(direction.norm()) > 0.5:
        distance = 5.0 * 1.1 * spread
        centre = middle + direction / direction.norm() * distance
        return _cube(centre, _SHARE_OF_VIEW * distance * float(tangent))
    return _cube(middle, 5.0 * 1.1 * spread)


def _half_view(camera: Camera) -> float:
    """Tangent of half the smaller field of view."""
    return 0.5 * min(camera.width / camera.fx, camera.height / camera.fy)


def _cube(centre: Tensor, half: float) -> Tensor:
    return torch.stack([centre - half, centre + half]).to(torch.float32)
