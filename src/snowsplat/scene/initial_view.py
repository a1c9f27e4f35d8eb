"""The initial view of a scene in a viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera, near_of_overview
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, look_at

# Distance of the camera of `overview` from the middle, relative to the radius that it shows.
_OVERVIEW_DISTANCE = 2.77
# What is farther from the median than this many times the median distance is considered background.
_BACKGROUND_RATIO = 4.0
# The rest extends from the first of these quantiles to the second, or to its ends if they are near.
_EXTENT = torch.tensor([0.02, 0.98], dtype=torch.float64)
_NEAR_END = 1.15  # times the second one
# Number of Gaussians that are used for medians and quantiles.
_ROWS_SAMPLED = 100_000


@dataclass(frozen=True)
class InitialView:
    """Position and target of a viewer's camera in the world frame. Up is −y.

    A window of any shape must show a rectangle around the target, such as that of a photo.
    """

    position: tuple[float, float, float]  # of the camera
    target: tuple[float, float, float]  # the viewer looks at this point and orbits it
    fov: float  # the angle of the longer side of the rectangle, in degrees
    aspect: float = 1.0  # width / height of the rectangle

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a window of this size, in pixels, that shows the complete rectangle."""
        across, down = self.tangents()
        focal = 0.5 * min(width / across, height / down)
        position, target, up = (
            torch.tensor(point, dtype=torch.float64)
            for point in (self.position, self.target, (0.0, -1.0, 0.0))
        )
        pose = look_at(position, target, up)
        near = near_of_overview(float((target - position).norm()))
        return Camera(width, height, focal, focal, width / 2, height / 2, pose, near)

    def with_aspect(self, aspect: float) -> InitialView:
        """The view of the smallest rectangle of this shape around the rectangle of this view."""
        across, down = self.tangents()
        longer = max(across, down * aspect) / min(aspect, 1.0)
        return replace(self, fov=_degrees(longer), aspect=aspect)

    def transformed(self, change: Similarity) -> InitialView:
        """The view of the same in the new world frame of ``change``; up is −y in both."""
        points = torch.tensor([self.position, self.target], dtype=torch.float64)
        position, target = change.apply(points)
        return replace(self, position=_point(position), target=_point(target))

    def tangents(self) -> tuple[float, float]:
        """Half of the width and of the height, at a distance of 1."""
        longer = math.tan(math.radians(self.fov / 2))
        return longer * min(self.aspect, 1.0), longer / max(self.aspect, 1.0)


def view_of_camera(camera: Camera, depth: float) -> InitialView:
    """The view of a photo. The target is ``depth`` world units along the optical axis."""
    pose = camera.world_from_cam
    across, down = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    fov = _degrees(max(across, down))
    target = pose[:, 3] + depth * pose[:, 2]
    return InitialView(_point(pose[:, 3]), _point(target), fov, across / down)


def bounding_sphere(gaussians: Gaussians) -> tuple[Tensor, float]:
    """The middle (3,) and the radius of what a scene shows; needs no cameras.

    The sphere contains 98% of the opaque Gaussians, all if the rest is near them, except for those
    much farther from the median than half of them: these are background of the object.
    """
    means = gaussians.means.detach()
    finite = means.isfinite().all(1)
    solid = finite & (gaussians.opacities.detach() > 0.2)
    seen = means[solid if bool(solid.any()) else finite].double().cpu()
    seen = seen[:: -(-len(seen) // _ROWS_SAMPLED) or 1]
    if not len(seen):
        return torch.zeros(3, dtype=torch.float64), 1.0
    median = seen.median(0).values
    distances = (seen - median).norm(dim=1)
    near = seen[distances <= _end(distances, _BACKGROUND_RATIO * float(distances.median()))]
    middle = near.quantile(_EXTENT, dim=0).mean(0)
    distances = (near - middle).norm(dim=1)
    return middle, max(_end(distances, float(distances.quantile(_EXTENT[1]))), 1e-6)


def _end(distances: Tensor, limit: float) -> float:
    """The largest distance, if that is at most slightly beyond a limit; else the limit."""
    largest = float(distances.max())
    return largest if largest <= _NEAR_END * limit else limit


def overview(gaussians: Gaussians) -> InitialView:
    """A view of the `bounding_sphere` from the front and slightly above; needs no cameras."""
    middle, radius = bounding_sphere(gaussians)
    direction = torch.tensor([0.0, -0.35, -1.0], dtype=torch.float64)
    position = middle + _OVERVIEW_DISTANCE * radius * direction / direction.norm()
    fov = math.degrees(2 * math.asin(1 / _OVERVIEW_DISTANCE))
    return InitialView(_point(position), _point(middle), fov)


def _degrees(tangent: float) -> float:
    """The angle of which half has this tangent."""
    return math.degrees(2 * math.atan(tangent))


def _point(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
