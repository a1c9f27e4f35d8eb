"""The initial view of a scene in a viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians

# The usual aspect ratio of a browser window.
_WINDOW_ASPECT = 1.6
# Field of view of `overview` along the longer side of the window, in degrees.
_OVERVIEW_FOV = 60.0
# The overview shows at most this many times the radius that contains half of the scene. What is
# farther away is considered background.
_BACKGROUND_RATIO = 2.5
# Number of Gaussians that are used for medians and quantiles.
_ROWS_SAMPLED = 100_000


@dataclass(frozen=True)
class InitialView:
    """Position and target of a viewer's camera in the world frame. Up is −y."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]  # the viewer looks at this point and orbits it
    fov: float  # degrees, along the longer side of the window


def view_of_camera(camera: Camera, depth: float) -> InitialView:
    """The view of a photo. The target is ``depth`` world units along the optical axis.

    A window of the usual aspect ratio shows the complete photo if the photo is in landscape format.
    For a portrait photo, the window shows only the middle part: to show the complete photo, the
    view would have to be wider than the photo, and the photos may not cover the areas at its sides.
    """
    pose = camera.world_from_cam
    short, long = sorted((0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy))
    fov = math.degrees(2.0 * math.atan(max(long, _WINDOW_ASPECT * short)))
    return InitialView(_point(pose[:, 3]), _point(pose[:, 3] + depth * pose[:, 2]), fov)


def overview(gaussians: Gaussians) -> InitialView:
    """A view of the middle of the scene from the front and slightly above; needs no cameras.

    The view contains 95% of the opaque Gaussians, unless half of them are much closer to the
    middle. Then the distant ones are background, and the view shows the object in front of them.
    """
    means = gaussians.means.detach()
    finite = means.isfinite().all(1)
    solid = finite & (gaussians.opacities.detach() > 0.2)
    seen = means[solid if bool(solid.any()) else finite].double().cpu()
    seen = seen[:: -(-len(seen) // _ROWS_SAMPLED) or 1]
    middle, radius = torch.zeros(3, dtype=torch.float64), 1.0
    if len(seen):
        middle = seen.median(0).values
        half, most = (
            (seen - middle).norm(dim=1).quantile(torch.tensor([0.5, 0.95]).double()).tolist()
        )
        radius = max(min(most, _BACKGROUND_RATIO * half), 1e-6)
    # The radius must fit into the height of a window in landscape format.
    distance = _WINDOW_ASPECT * radius / math.tan(math.radians(_OVERVIEW_FOV / 2))
    direction = torch.tensor([0.0, -0.35, -1.0], dtype=torch.float64)
    position = middle + distance * direction / direction.norm()
    return InitialView(_point(position), _point(middle), _OVERVIEW_FOV)


def _point(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
