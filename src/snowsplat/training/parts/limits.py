"""What a Gaussian may not be: too near to the cameras, too large, or too thin for the photos.

`NearLimit`: no Gaussian is much nearer to a camera than the points that it sees.

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

`ScaleLimit`: no Gaussian is large compared to its distance from the cameras.

A few Gaussians grow until they are larger than their distance from the cameras. Each photo shows
only their tails, so the optimiser can use them like a tint for single photos. They cover other
views like a veil: in one training run with the dataset fox, ten of 200,000 Gaussians reduced the
PSNR of a held-out photo from 33.0 to 26.3 dB. The approximation of the projection (eq. 5 of the
paper) is also inaccurate for them.

Mip-Splatting (Yu et al., CVPR 2024) derives a lower limit of the scales from the distance to the
nearest camera; this is an upper limit.

`SmoothingFilter`: no Gaussian is thinner than what the photos can show of it, except for discs.

A photo of focal length f samples a Gaussian at depth d with the rate f / d, in pixels per world
unit. Let ν be the largest rate of all photos that show it. Details that are much finer than 1 / ν
cannot be trained. But in the photos a thinner Gaussian looks the same, because the projection blurs
it to the size of a pixel; nearer to the camera, or in a larger image, it becomes an edge or a
needle. Mip-Splatting (Yu et al., CVPR 2024) therefore convolves each Gaussian with one of the
variance s / ν², its 3D smoothing filter: Σ + s / ν² I. The Gaussians that result are those whose
standard deviations are at least √s / ν. So here this is a lower limit of the scales, without
further parameters, and every viewer shows the filtered scene.

The smallest of the three scales has no limit. A disc of any thickness looks the same from the
front, and surfaces need thin discs; with a limit for all scales, the photos are reproduced less
well. A needle has two small scales, so there are no needles.
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
#: At most this number of cameras is used, evenly chosen, to limit the time.
_SCALE_CAMERAS = 64
#: s: the variance of the filter, in units of the distance between samples, squared.
VARIANCE = 0.2


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


class ScaleLimit(Part):
    """Limits the scales. It has no state."""

    _spheres: Tensor  # the cameras, see `spheres_of`

    name = "scale_limit"

    def __init__(self, ratio: float) -> None:
        """
        ``ratio``: largest scale, in units of the distance to the nearest camera.
        """
        self.ratio = ratio

    def begin(self, run: Run) -> None:
        """Choose the cameras."""
        cameras = run.dataset_cameras[:: math.ceil(len(run.dataset_cameras) / _SCALE_CAMERAS)]
        self._spheres = spheres_of(cameras, [0.0] * len(cameras)).to(run.device)

    def between(self, run: Run) -> None:
        """Reduce the scales that exceed the limit, in place, in every `INTERVAL`-th step."""
        if run.schedule.multiples(run.step, INTERVAL):
            _, distances = ops.points_in_spheres(run.gaussians.means, self._spheres)
            # A mean may be in the centre of a camera.
            limit = (self.ratio * distances.clamp_min(torch.finfo(torch.float32).tiny)).log()
            scales = run.gaussians.log_scales
            scales.copy_(torch.minimum(scales, limit[:, None]))


class SmoothingFilter(Part):
    """Limits the scales. It has no state."""

    name = "smoothing"
    _frusta: Frusta

    def begin(self, run: Run) -> None:
        """Compute the frusta of the training views."""
        depths = [(camera.near, math.inf) for camera in run.dataset_cameras]
        self._frusta = frusta_of(run.dataset_cameras, depths).to(run.gaussians.means)

    def between(self, run: Run) -> None:
        """Raise the scales below the limit, except for the smallest one of each Gaussian, in place,
        in every `INTERVAL`-th step.
        """
        if run.schedule.multiples(run.step, INTERVAL):
            # The most pixels per world unit with which an image shows the mean, or 0.
            _, rates = ops.points_in_frusta(run.gaussians.means, self._frusta)
            limit = math.sqrt(VARIANCE) / rates  # inf for a Gaussian that no photo shows
            limit = limit.nan_to_num(posinf=0.0).log()
            scales = run.gaussians.log_scales
            smallest = scales.argmin(1, keepdim=True)
            raised = torch.maximum(scales, limit[:, None])
            scales.copy_(raised.scatter(1, smallest, scales.gather(1, smallest)))
