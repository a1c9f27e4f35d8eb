"""Where a viewer of a scene starts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.camera import Camera
from snowsplat.gaussians import Gaussians

_OVERVIEW_FOV = 60.0  # degrees
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
    """From where a photo was taken, to what lies ``depth`` (world units) along its axis."""
    pose = camera.world_from_cam
    size, focal = max((camera.width, camera.fx), (camera.height, camera.fy))
    fov = math.degrees(2.0 * math.atan(0.5 * size / focal))
    return StartView(_point(pose[:, 3]), _point(pose[:, 3] + depth * pose[:, 2]), fov)


def overview(gaussians: Gaussians) -> StartView:
    """From the front and a little above, the middle of the Gaussians in sight: without cameras.

    Half of what is opaque lies within the radius that fills half of the picture: a far background
    does not send the start away from the thing in front of it.
    """
    means = gaussians.means.detach()
    good = means.isfinite().all(1) & (gaussians.opacities.detach() > 0.2)
    seen = means[good] if bool(good.any()) else means[means.isfinite().all(1)]
    seen = seen[:: -(-len(seen) // _ROWS_SAMPLED) or 1].double().cpu()
    middle = seen.median(0).values if len(seen) else torch.zeros(3, dtype=torch.float64)
    distances = (seen - middle).norm(dim=1)
    radius = float(distances.median()) if len(seen) else 1.0
    distance = 2.0 * max(radius, 1e-6) / math.tan(math.radians(_OVERVIEW_FOV / 2))
    direction = torch.tensor([0.0, -0.35, -1.0], dtype=torch.float64)
    position = middle + distance * direction / direction.norm()
    return StartView(_point(position), _point(middle), _OVERVIEW_FOV)


def _point(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
