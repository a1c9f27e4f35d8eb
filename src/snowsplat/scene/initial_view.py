"""Where a viewer of a scene starts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians

_WINDOW = 1.6  # the usual ratio of a window's sides
_OVERVIEW_FOV = 60.0  # degrees
_FAR = 2.5  # times the distance within which half of a scene lies: background
_ROWS_SAMPLED = 100_000  # enough for medians


@dataclass(frozen=True)
class StartView:
    """A place to stand (world), the point looked at and turned around, and how wide one sees.

    ``fov`` is in degrees, along the longer side of the window. Up is −y.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float


def view_of_camera(camera: Camera, depth: float) -> StartView:
    """From where a photo was taken, to what lies ``depth`` (world units) along its axis.

    A usual window shows the whole photo if that is not upright; of an upright one its middle, since
    on both sides of it there is what the photos may not have seen.
    """
    pose = camera.world_from_cam
    short, long = sorted((0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy))
    fov = math.degrees(2.0 * math.atan(max(long, _WINDOW * short)))
    return StartView(_point(pose[:, 3]), _point(pose[:, 3] + depth * pose[:, 2]), fov)


def overview(gaussians: Gaussians) -> StartView:
    """From the front and a little above, the middle of the Gaussians in sight: without cameras.

    Nearly all that is opaque fits into a usual window, unless half of it is much nearer to its
    middle: a far background does not send the start away from the thing in front of it.
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
        radius = max(min(most, _FAR * half), 1e-6)
    # In the height of a window wider than high.
    distance = _WINDOW * radius / math.tan(math.radians(_OVERVIEW_FOV / 2))
    direction = torch.tensor([0.0, -0.35, -1.0], dtype=torch.float64)
    position = middle + distance * direction / direction.norm()
    return StartView(_point(position), _point(middle), _OVERVIEW_FOV)


def _point(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
