"""The coordinates in which `PoseRefinement` optimises camera poses.

The pose of view i is a small motion of the camera after its first pose [R | t]:

    cam_from_world = [exp(ω) R | exp(ω) t + τ],   (ω, τ) = Pᵢ ηᵢ

ω (3,) is a rotation about the centre of the camera, in radians, and τ (3,) a translation in the
axes of the camera, in world units. Pᵢ = (Hᵢ + 0.1 diag Hᵢ)^(−1/2) with Hᵢ = mean of JᵀJ over
points in the view, where J (2, 6) is the derivative of the pixel position of a point with respect
to (ω, τ). So a component of η is about a shift of the image in pixels, in the root mean square,
and rotations and translations that shift the image alike do not compete (CamP: Park et al.,
SIGGRAPH Asia 2023).

The images do not change if all cameras and the scene are moved and scaled together. So the data
cannot determine this similarity transform, the *gauge*; see `Gauge`.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import transform_points

#: P is computed from about this number of points in a view, or from a grid of pixels.
_POINTS = 500
_FEWEST_POINTS = 20
_DAMPING = 0.1


def after_motion(cam_from_world: Tensor, motion: Tensor) -> Tensor:
    """(3, 4) float64: a pose [R | t] (3, 4) after a motion (ω, τ) (6,): see the module."""
    x, y, z = motion[:3].unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # Rodrigues: exp(ω) = I + (sin θ / θ) [ω]× + ((1 − cos θ) / θ²) [ω]×², θ = |ω|.
    angle = motion[:3].norm() / math.pi
    square = 0.5 * torch.sinc(0.5 * angle).square()
    turn = torch.eye(3, dtype=motion.dtype, device=motion.device)
    turn = turn + torch.sinc(angle) * cross + square * (cross @ cross)
    pose = turn @ cam_from_world.to(motion.dtype)
    return torch.cat([pose[:, :3], pose[:, 3:] + motion[3:, None]], 1)


def pixel_hessian(camera: Camera, dataset: Dataset) -> Tensor:
    """(7, 7) float64: the mean of JᵀJ for (ω, τ, log f), in pixels; see the module."""
    camera = camera.to(torch.device("cpu"))
    pose = camera.cam_from_world.double()
    points = torch.zeros(0, 3) if dataset.points is None else dataset.points.xyz.cpu()
    seen = points[camera.sees(points.double())[1]].double()
    if len(seen) >= _FEWEST_POINTS:
        x, y, z = transform_points(pose, seen[:: max(1, len(seen) // _POINTS)]).unbind(1)
    else:  # a grid of pixels, at the depth of the middle of the scene
        middle = dataset.bounds.double().mean(0, keepdim=True)
        z = transform_points(pose, middle)[0, 2].clamp_min(0.1 * dataset.extent)
        u = (torch.arange(20).double() + 0.5) / 20
        x = ((u * camera.width - camera.cx) / camera.fx * z).repeat(20)
        y = ((u * camera.height - camera.cy) / camera.fy * z).repeat_interleave(20)
        z = z.expand(400)
    zero = torch.zeros_like(x)
    u, v = x / z, y / z
    # du = fx (dx − u dz) / z, and dp = ω × p + τ for the point p = (x, y, z).
    row_x = [-u * v, 1.0 + u * u, -v, 1.0 / z, zero, -u / z, u]
    row_y = [-(1.0 + v * v), u * v, u, zero, 1.0 / z, -v / z, v]
    j = torch.cat([camera.fx * torch.stack(row_x, 1), camera.fy * torch.stack(row_y, 1)])
    return 2.0 * (j.T @ j) / len(j)


def whitening(hessian: Tensor) -> Tensor:
    """(6, 6) symmetric: P of the module."""
    damped = hessian + _DAMPING * torch.diag(hessian.diagonal())
    values, vectors = torch.linalg.eigh(damped)
    return vectors / values.sqrt() @ vectors.T


def gauge_motions(cameras: Sequence[Camera], centre: Tensor, scale: float) -> Tensor:
    """(V, 6, 7) float64: the motions (ω, τ) of cameras whose images do not change if the scene
    turns by θ about ``centre``, moves by ``scale`` · σ and grows by the factor 1 + s, for each of
    the seven numbers (θ, σ, s), to first order.
    """
    motions = []
    for camera in cameras:
        pose = camera.cam_from_world.detach().cpu().double()
        rotation, t = pose[:, :3], pose[:, 3] + pose[:, :3] @ centre
        # ω = −R θ and τ = (R θ) × t − R σ + s t.
        motion = torch.zeros(6, 7, dtype=torch.float64)
        motion[:3, :3] = -rotation
        motion[3:, :3] = torch.linalg.cross(rotation, t[:, None].expand(3, 3), dim=0)
        motion[3:, 3:6] = -scale * rotation
        motion[3:, 6] = t
        motions.append(motion)
    return torch.stack(motions)


class Gauge:
    """The part of the motions of cameras that is a similarity transform of the whole scene.

    It is found by least squares of (ω, τ / extent) over all views.
    """

    def __init__(self, cameras: Sequence[Camera], units: Tensor, extent: float) -> None:
        """
        ``units``: (V, 6, 6): P of each camera, on the device of the motions.
        """
        positions = [camera.position.detach().cpu().double() for camera in cameras]
        motions = gauge_motions(cameras, torch.stack(positions).mean(0), extent)
        weights = torch.tensor(3 * [1.0] + 3 * [1.0 / extent], dtype=torch.float64)
        columns = (weights[:, None] * motions).flatten(0, 1)
        u, singular, _ = torch.linalg.svd(columns, full_matrices=False)
        self._basis = u[:, singular > 1e-9 * singular[0]].to(units.device)  # (6V, 7) or fewer
        self._weighted = weights.to(units.device)[:, None] * units
        self._inverse = torch.linalg.inv(self._weighted)

    def part(self, motions: Tensor) -> Tensor:
        """The part (V, 6) of motions η (V, 6)."""
        weighted = torch.einsum("vij,vj->vi", self._weighted, motions).flatten()
        inside = (self._basis @ (self._basis.T @ weighted)).view_as(motions)
        return torch.einsum("vij,vj->vi", self._inverse, inside)
