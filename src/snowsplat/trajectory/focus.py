"""Properties of a set of cameras: up direction, focus, viewing distance."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.orientation import scene_up

#: The up direction of an oriented scene.
DEFAULT_UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)

# Optical axes within about 8° of each other are considered parallel. This value is the squared sine
# of the angle; it is compared with an eigenvalue.
_PARALLEL = math.sin(math.radians(8)) ** 2
# Number of cameras and points that are used for medians.
_CAMERAS_SAMPLED = 16
_POINTS_SAMPLED = 20_000


def positions_of(cameras: Sequence[Camera]) -> Tensor:
    """(N, 3) float64: the camera centres in the world frame."""
    return torch.stack([camera.position.detach() for camera in cameras]).to(torch.float64)


def rotations_of(cameras: Sequence[Camera]) -> Tensor:
    """(N, 3, 3) float64: rotations of cam_from_world; rows are the right, down and forward axes."""
    poses = torch.stack([camera.cam_from_world.detach() for camera in cameras])
    return poses[:, :, :3].to(torch.float64)


def typical(cameras: Sequence[Camera]) -> Camera:
    """The camera with the median field of view."""
    return sorted(cameras, key=lambda camera: camera.fx / camera.width)[len(cameras) // 2]


def up_of(cameras: Sequence[Camera]) -> Tensor:
    """The up direction, a unit vector (3,) in the world frame; see `scene_up`."""
    return torch.from_numpy(scene_up(rotations_of(cameras).cpu().numpy()))


def viewing_distance(cameras: Sequence[Camera], points: Tensor) -> float:
    """The median over cameras of the median depth of the points that a camera sees, world units.

    If none of the cameras (at least one) sees one of the ``points`` (P, 3), it is the distance
    between the median camera centre and the median point. Without points it is 1.
    """
    points = points.detach().to(torch.float64)[:: -(-len(points) // _POINTS_SAMPLED) or 1]
    medians = []
    for camera in cameras[:: -(-len(cameras) // _CAMERAS_SAMPLED)]:
        seen = camera.depths_in_view(points)
        if len(seen):
            medians.append(float(seen.median()))
    if medians:
        return sorted(medians)[len(medians) // 2]
    if not len(points):
        return 1.0
    middle = positions_of(cameras).median(0).values
    return float((points.median(0).values - middle).norm()) or 1.0


def focus_of(cameras: Sequence[Camera], distance: float) -> Tensor:
    """The focus: the point (3,) that is nearest to the optical axes, in the world frame.

    If the axes are nearly parallel or intersect behind the cameras (at least one), the focus is
    ``distance``, in world units from the cameras to what they see, in front of the mean camera
    centre. If the cameras look in all directions, it is the mean centre.
    """
    centres, forward = positions_of(cameras), rotations_of(cameras)[:, 2]
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) > _PARALLEL:
        weights = torch.ones(len(centres), dtype=torch.float64)
        # Reweighted least squares minimises the sum of distances, which is robust to outliers.
        for _ in range(20):
            matrix = (weights[:, None, None] * across).sum(0)
            at_centres = (across @ centres[:, :, None])[:, :, 0]
            point = torch.linalg.solve(matrix, (weights[:, None] * at_centres).sum(0))
            errors = ((point - centres)[:, None] @ across)[:, 0].norm(dim=1)
            weights = 1 / errors.clamp_min(0.01 * distance)
        ahead = ((point - centres) * forward).sum(1)
        if float((ahead > 0.1 * distance).double().mean()) > 0.75:
            return point
    mean = forward.mean(0)
    if float(mean.norm()) < 0.1:  # the cameras look outwards in all directions
        return centres.mean(0)
    return centres.mean(0) + distance * mean / mean.norm()


def weighted_quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """The weighted quantile, a scalar, of ``values`` (P,), P > 0."""
    order = values.argsort()
    sums = weights[order].cumsum(0)
    index = torch.searchsorted(sums, share * sums[-1]).clamp_max(len(values) - 1)
    return values[order[int(index)]]


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another image size in pixels and aspect ratio, and with square pixels.

    The area of the field of view does not change: a wider image shows more at the sides and less
    above and below.
    """
    # Keep the ratio of the focal length to the geometric mean of width and height.
    focal = math.sqrt(camera.fx * camera.fy * (width * height) / (camera.width * camera.height))
    return dataclasses.replace(
        camera, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2
    )
