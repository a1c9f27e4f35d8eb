"""`NearLimit`: no Gaussian is much nearer to a camera than the points that it sees.

With few photos, Gaussians appear in the empty space between the cameras and the scene. Each of them
represents a part of the background of some photos at a wrong depth, so these photos do not show
that it is wrong. But it covers the scene in other views: such floaters are the most visible error
of scenes with few photos. The points of the dataset tell how near to a camera the scene begins:

    limit = share · (the depth that 98% of the points in the view exceed)

Two kinds of Gaussians are removed.

- Those in front of the limit, in the training views and in unseen views beside and between them.
- Those nearer to a camera than its limit, in any direction, if at most one photo shows the centre.
  People walked there with the camera, so the space is probably empty. A Gaussian that one photo
  alone shows may have any depth. What two photos show there is kept: it may be a wall.

FreeNeRF (Yang et al., CVPR 2023) also penalises density near the cameras ("occlusion
regularisation"). There, the range is a setting, and there are no unseen views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
#: A Gaussian near a camera is removed if at most this number of photos show its centre.
_UNCONFIRMED = 1
#: This number of Gaussians is processed at a time, to limit the memory.
_ROWS = 1 << 14


class NearLimit(Part):
    """Removes Gaussians that are too near to a camera. It has no state."""

    name = "near_limit"

    def __init__(self, share: float) -> None:
        """
        Args:
            share: the limit, relative to the depth of the nearest points.
        """
        self.share = share
        self._views: _Views | None = None  # None: no limit
        self._photos: _Views
        self._spheres: Tensor  # (C, 4): the position of a camera, and its limit

    def begin(self, run: Run) -> None:
        """Compute the limits, from the points of the dataset; without points, there are none."""
        if run.dataset.points is None:
            return
        cpu = torch.device("cpu")
        device = run.dataset_cameras[0].cam_from_world.device
        cameras = [camera.to(cpu) for camera in run.dataset_cameras]
        points = run.dataset.points.xyz.to(cpu, torch.float64)
        used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
        unseen = unseen_cameras(used, _sample(points, _PAIRING))
        sample = _sample(points, _POINTS)
        limits = [self.share * nearest_depth(camera, sample) for camera in used + unseen]
        views = [(c, limit) for c, limit in zip(used + unseen, limits, strict=True) if limit > 0.0]
        if not views:
            return
        self._views = _Views.of(views, device)
        self._photos = _Views.of([(camera, math.inf) for camera in cameras], device)
        spheres = [
            [*camera.position.tolist(), limit]
            for camera, limit in zip(used, limits, strict=False)  # without the unseen ones
        ]
        self._spheres = torch.tensor(spheres, dtype=torch.float32, device=device)

    def between(self, run: Run) -> None:
        """Make the Gaussians that are too near transparent, in every `INTERVAL`-th step."""
        if self._views is not None and run.schedule.multiples(run.step, INTERVAL):
            parts = run.gaussians.means.split(_ROWS)
            near = torch.cat([self._in_front(part) | self._unconfirmed(part) for part in parts])
            run.gaussians.opacity_logits.masked_fill_(near, REMOVED)

    def _in_front(self, means: Tensor) -> Tensor:
        """(M,) bool: which of the means (M, 3) are in front of the limit of a view."""
        assert self._views is not None
        return self._views.count(means) > 0

    def _unconfirmed(self, means: Tensor) -> Tensor:
        """(M,) bool: which means (M, 3) are near a camera, and in at most one photo."""
        # Not as |a|² + |b|² − 2 a·b, whose digits would not suffice far from the origin.
        exact = "donot_use_mm_for_euclid_dist"
        distances = torch.cdist(means, self._spheres[:, :3], compute_mode=exact)
        near = (distances < self._spheres[:, 3]).any(1)
        rows = near.nonzero()[:, 0]
        near[rows[self._photos.count(means[rows]) > _UNCONFIRMED]] = False
        return near


@dataclass(frozen=True)
class _Views:
    """Cameras as tensors: V views."""

    to_image: Tensor  # (V, 3, 4) float32, K [R | t]
    size: Tensor  # (V, 2) float32, pixels
    limit: Tensor  # (V,) float32, the largest depth that counts

    @staticmethod
    def of(views: Sequence[tuple[Camera, float]], device: torch.device) -> _Views:
        """The cameras with their limits."""
        to_image = torch.stack(
            [c.intrinsics @ c.cam_from_world.to(torch.float64) for c, _ in views]
        )
        size = [[float(c.width), float(c.height)] for c, _ in views]
        return _Views(
            to_image.to(device, torch.float32),
            torch.tensor(size, device=device),
            torch.tensor([limit for _, limit in views], device=device),
        )

    def count(self, means: Tensor) -> Tensor:
        """(M,) int64: the number of views in which each of the means (M, 3) is before the limit."""
        depths = means @ self.to_image[:, 2, :3].T + self.to_image[:, 2, 3]
        row, view = torch.nonzero((depths > 0.0) & (depths < self.limit), as_tuple=True)
        affine = self.to_image[view]
        projected = (affine[:, :2, :3] @ means[row, :, None])[:, :, 0] + affine[:, :2, 3]
        pixel = projected / depths[row, view, None]
        inside = ((pixel >= 0.0) & (pixel < self.size[view])).all(1)
        return torch.bincount(row[inside], minlength=len(means))


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
