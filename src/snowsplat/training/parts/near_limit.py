"""`NearLimit`: no Gaussian is much nearer to a camera than the points that it sees.

With few photos, Gaussians appear in the empty space between the cameras and the scene. Each of them
represents a part of the background of some photos at a wrong depth, so these photos do not show
that it is wrong. But it covers the scene in other views: such floaters are the most visible error
of scenes with few photos. The points of the dataset tell how near to a camera the scene begins. So
Gaussians in front of

    share · (the depth that 98% of the points in the view exceed)

are removed, in the training views and in unseen views beside and between them.

FreeNeRF (Yang et al., CVPR 2023) also penalises density near the cameras ("occlusion
regularisation"). There, the range is a setting, and there are no unseen views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.training.parts.part import REMOVED, Part
from snowsplat.training.parts.unseen_cameras import beside
from snowsplat.training.starts.source_views import source_views

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two applications.
INTERVAL = 100
#: At most this number of cameras of training views is used, evenly chosen, to limit the time.
_CAMERAS = 64
#: Each of them is paired with this number of other cameras that show the same points. There are
#: unseen cameras between the two, and beside the first one: see `beside`.
_PARTNERS = 2
_SHARES = (-0.5, 0.25)
#: Number of points with which cameras are paired, and from which depths are computed.
_PAIRING, _POINTS = 1000, 10_000
#: The nearest points are ignored, because some points are wrong.
_QUANTILE = 0.02
#: Cameras that see fewer points have no limit.
_FEWEST_POINTS = 50
#: This number of Gaussians is processed at a time, to limit the memory.
_ROWS = 1 << 14


class NearLimit(Part):
    """Removes Gaussians that are too near to a camera. It has no state."""

    name = "near_limit"

    def __init__(self, share: float) -> None:
        """
        Args:
            share: the nearest depth of a Gaussian, relative to that of the points.
        """
        self.share = share
        self._views: Tensor | None = None  # None: no limit

    def begin(self, run: Run) -> None:
        """Compute the limits, from the points of the dataset; without points, there are none."""
        if run.dataset.points is None:
            return
        cameras, points = run.dataset_cameras, run.dataset.points.xyz
        device = cameras[0].cam_from_world.device
        cpu = torch.device("cpu")
        used = [camera.to(cpu) for camera in cameras[:: math.ceil(len(cameras) / _CAMERAS)]]
        points = points.to(cpu, torch.float64)
        views = []
        for camera in used + unseen_cameras(used, _sample(points, _PAIRING)):
            depth = nearest_depth(camera, _sample(points, _POINTS))
            if depth > 0.0:
                views.append(_row(camera, self.share * depth))
        if views:
            self._views = torch.stack(views).to(device, torch.float32)

    def between(self, run: Run) -> None:
        """Make the Gaussians that are too near transparent, in every `INTERVAL`-th step."""
        if self._views is not None and run.schedule.multiples(run.step, INTERVAL):
            near = torch.cat([self._is_near(means) for means in run.gaussians.means.split(_ROWS)])
            run.gaussians.opacity_logits.masked_fill_(near, REMOVED)

    def _is_near(self, means: Tensor) -> Tensor:
        """(M,) bool: which of the means (M, 3) are in front of the limit of a view."""
        assert self._views is not None
        limits, size = self._views[:, 0], self._views[:, 1:3]
        to_image = self._views[:, 3:].reshape(-1, 3, 4)
        depths = means @ to_image[:, 2, :3].T + to_image[:, 2, 3]
        row, view = torch.nonzero((depths > 0.0) & (depths < limits), as_tuple=True)
        affine = to_image[view]
        projected = (affine[:, :2, :3] @ means[row, :, None])[:, :, 0] + affine[:, :2, 3]
        pixel = projected / depths[row, view, None]
        inside = ((pixel >= 0.0) & (pixel < size[view])).all(1)
        near = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        near[row[inside]] = True
        return near


def unseen_cameras(cameras: Sequence[Camera], points: Tensor) -> list[Camera]:
    """Cameras between each camera and others that show the same points, and on its other side.

    Args:
        points: (P, 3) in the world frame, a sample of the scene.
    """
    partners = source_views(cameras, points, _PARTNERS)
    return [
        beside(cameras[i], cameras[j], share)
        for i, chosen in enumerate(partners)
        for j in chosen
        for share in _SHARES
    ]


def nearest_depth(camera: Camera, points: Tensor) -> float:
    """The depth that 98% of the points (P, 3) in the view exceed; 0 if it shows too few points."""
    seen = camera.depths_in_view(points)
    return float(torch.quantile(seen, _QUANTILE)) if len(seen) >= _FEWEST_POINTS else 0.0


def _sample(points: Tensor, count: int) -> Tensor:
    return points[:: max(1, len(points) // count)]


def _row(camera: Camera, limit: float) -> Tensor:
    """(15,) float64: the limit, the size of the image, and K [R | t], row by row."""
    affine = camera.intrinsics @ camera.cam_from_world.to(torch.float64)
    size = torch.tensor([limit, camera.width, camera.height], dtype=torch.float64)
    return torch.cat([size, affine.reshape(-1)])
