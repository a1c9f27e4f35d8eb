"""The near plane of the cameras of a dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.dataset import scene_extent
from snowsplat.data.frame.bounds import scene_bounds
from snowsplat.scene.camera import Camera, near_plane
from snowsplat.util.process import single_threaded

# At most this number of cameras is used, evenly chosen, to limit the time; of the points about this
# number, and more if that is too few for most cameras: each may see a small part of a large scene.
_CAMERAS, _POINTS, _MORE = 64, 10_000, 8
# The nearest points of a camera are ignored, because some points are wrong; and so are the cameras
# with the nearest points, of which some may be wrong.
_NEAREST, _NEAREST_CAMERAS = 0.02, 0.1
# Cameras that see fewer points are ignored.
_FEWEST = 20


def near_of(cameras: Sequence[Camera], points: Tensor | None) -> float:
    """The near plane for all cameras of a scene, in world units; see `near_plane`.

    It depends on the depths of the points that the cameras see. Without points, it depends on the
    distance between the cameras and the middle of `scene_bounds`. That is a guess if the cameras
    look in the same direction, so no more than the extent of the cameras is used.

    Args:
        cameras: at least one.
        points: (P, 3) in the world frame, or None.
    """
    used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
    depths = []
    if points is not None:
        step = max(1, len(points) // _POINTS)
        while len(depths := _depths(used, points[::step])) < len(used) / 2 and step > 1:
            step = max(1, step // _MORE)
    if depths:
        nearest, medians = np.array(depths).T
        return near_plane(float(np.median(medians)), float(np.quantile(nearest, _NEAREST_CAMERAS)))
    middle = scene_bounds(used).double().mean(0)
    away = [float((camera.position.detach() - middle).norm()) for camera in used]
    return near_plane(min(float(np.median(away)), scene_extent(used)))


@single_threaded()  # for so few points, threads take longer to start than to compute
def _depths(cameras: Sequence[Camera], points: Tensor) -> list[tuple[float, float]]:
    """For each camera that sees enough points: their 2% quantile and their median depth."""
    points = points.detach().cpu().double()
    levels = torch.tensor([_NEAREST, 0.5], dtype=torch.float64)
    found = []
    for camera in cameras:
        seen = camera.depths_in_view(points)
        if len(seen) >= _FEWEST:
            nearest, median = torch.quantile(seen, levels).tolist()
            found.append((nearest, median))
    return found
