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
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Frusta
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid
from snowsplat.scene.sight import frusta_of, spheres_of
from snowsplat.training.parts.part import REMOVED, Part
from snowsplat.training.starts.photos import in_threads
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


class NearLimit(Part):
    """Removes Gaussians that are too near to a camera. It has no state."""

    name = "near_limit"

    def __init__(self, share: float) -> None:
        """
        ``share``: the limit, relative to the depth of the nearest points.
        """
        self.share = share
        self._views: Frusta | None = None  # before the limits; None: no limit
        self._photos: Frusta
        self._spheres: Tensor  # of the training views, see `spheres_of`; the radius is the limit

    def begin(self, run: Run) -> None:
        """Compute the limits, from the points of the dataset; without points, there are none."""
        if run.dataset.points is None:
            return
        cpu = torch.device("cpu")
        device = run.dataset_cameras[0].cam_from_world.device
        cameras = [camera.to(cpu) for camera in run.dataset_cameras]
        points = run.dataset.points.xyz.to(cpu, torch.float64)
        used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
        unseen = unseen_cameras(used, _sample(points, _PAIRING).to(device))
        sample = _sample(points, _POINTS)
        nearest = in_threads(lambda camera: nearest_depth(camera, sample), used + unseen, cpu)
        limits = [self.share * depth for depth in nearest]
        views = [(c, limit) for c, limit in zip(used + unseen, limits, strict=True) if limit > 0.0]
        if not views:
            return
        like = torch.empty(0, device=device)
        self._views = frusta_of([c for c, _ in views], [(0.0, far) for _, far in views]).to(like)
        self._photos = frusta_of(cameras, [(0.0, math.inf)] * len(cameras)).to(like)
        self._spheres = spheres_of(used, limits[: len(used)]).to(device)

    def between(self, run: Run) -> None:
        """Make the Gaussians that are too near transparent, in every `INTERVAL`-th step."""
        if self._views is not None and run.schedule.multiples(run.step, INTERVAL):
            means = run.gaussians.means
            in_front = ops.points_in_frusta(means, self._views)[0] > 0
            near = ops.points_in_spheres(means, self._spheres)[0] > 0
            unconfirmed = ops.points_in_frusta(means, self._photos)[0] <= _UNCONFIRMED
            run.gaussians.opacity_logits.masked_fill_(in_front | near & unconfirmed, REMOVED)


def unseen_cameras(cameras: Sequence[Camera], points: Tensor) -> list[Camera]:
    """Cameras between each camera and others that show the same points, and on its other side.

    ``points``: (P, 3) in the world frame, a sample of the scene; on the device that computes.
    """
    partners = source_views(cameras, points, _PARTNERS)
    return [
        beside(cameras[i], cameras[j], share)
        for i, chosen in enumerate(partners)
        for j in chosen
        for share in _SHARES
    ]


def beside(first: Camera, second: Camera, share: float) -> Camera:
    """The first camera, moved and rotated away from the second one by a share of their difference.

    With a negative share, it moves towards the second one; −1 is the pose of the second camera.

    The rotation is the nearest one to (1 + share) R₁ − share R₂.
    """
    a, b = (camera.world_from_cam.to(torch.float64) for camera in (first, second))
    moved = (1.0 + share) * a - share * b
    u, _, vt = torch.linalg.svd(moved[:, :3])
    if torch.det(u @ vt) < 0.0:  # the two directions are almost opposite
        vt[2] = -vt[2]
    world_from_cam = torch.cat([u @ vt, moved[:, 3:]], dim=1)
    return replace(first, cam_from_world=invert_rigid(world_from_cam))


def nearest_depth(camera: Camera, points: Tensor) -> float:
    """The depth that 98% of the points (P, 3) in the view exceed; 0 if it shows too few points."""
    seen = camera.depths_in_view(points)
    return float(torch.quantile(seen, _QUANTILE)) if len(seen) >= _FEWEST_POINTS else 0.0


def _sample(points: Tensor, count: int) -> Tensor:
    return points[:: max(1, len(points) // count)]
