"""What some cameras see: which way is up for them, what they look at, from how far."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.orientation import up_direction

#: Up in a scene that stands upright.
HOUSE_UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)

_LEVEL = math.sin(math.radians(5))  # as people hold cameras, or better
_PARALLEL = math.sin(math.radians(8)) ** 2
_CAMERAS = 16  # enough for a median
_POINTS = 20_000


def positions_of(cameras: Sequence[Camera]) -> Tensor:
    """(N, 3) world."""
    return torch.stack([camera.position.detach() for camera in cameras]).to(torch.float64)


def rotations_of(cameras: Sequence[Camera]) -> Tensor:
    """(N, 3, 3) of cam_from_world: the rows are the cameras' right, down and forward."""
    poses = torch.stack([camera.cam_from_world.detach() for camera in cameras])
    return poses[:, :, :3].to(torch.float64)


def typical(cameras: Sequence[Camera]) -> Camera:
    """The one whose angle of view is the median."""
    return sorted(cameras, key=lambda camera: camera.fx / camera.width)[len(cameras) // 2]


def up_of(cameras: Sequence[Camera]) -> Tensor:
    """(3,) unit: −y where most cameras are level in that frame, else what they make of it.

    Many datasets of COLMAP do not stand upright.
    """
    rotations = rotations_of(cameras)
    right, upper = rotations[:, 0], -rotations[:, 1].mean(0)
    if float((right @ HOUSE_UP).abs().median()) < _LEVEL and float(upper @ HOUSE_UP) > 0:
        return HOUSE_UP
    return torch.from_numpy(up_direction(rotations.cpu().numpy()))


def viewing_distance(cameras: Sequence[Camera], points: Tensor) -> float:
    """World units: how far is, for most cameras, most of what they see of points (P, 3).

    Where they see none, it is the mean distance between the cameras' middle and the points'.
    """
    points = points.detach().to(torch.float64)[:: -(-len(points) // _POINTS) or 1]
    medians = []
    for camera in cameras[:: -(-len(cameras) // _CAMERAS)]:
        pixels, depth = camera.project(points)
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        seen = depth[(depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)]
        if len(seen):
            medians.append(float(seen.median()))
    if medians:
        return sorted(medians)[len(medians) // 2]
    if not len(points):
        return 1.0
    middle = positions_of(cameras).median(0).values
    return float((points.median(0).values - middle).norm()) or 1.0


def focus_of(cameras: Sequence[Camera], distance: float) -> Tensor:
    """(3,) what the cameras look at: the point nearest to their optical axes.

    Where these are nearly parallel or meet behind the cameras, it is ``distance`` ahead of their
    middle.
    """
    centres, forward = positions_of(cameras), rotations_of(cameras)[:, 2]
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) > _PARALLEL:
        weights = torch.ones(len(centres), dtype=torch.float64)
        for _ in range(20):  # towards the least sum of distances: a few odd ones do not count
            matrix = (weights[:, None, None] * across).sum(0)
            at_centres = (across @ centres[:, :, None])[:, :, 0]
            point = torch.linalg.solve(matrix, (weights[:, None] * at_centres).sum(0))
            misses = ((point - centres)[:, None] @ across)[:, 0].norm(dim=1)
            weights = 1 / misses.clamp_min(0.01 * distance)
        ahead = ((point - centres) * forward).sum(1)
        if float((ahead > 0.1 * distance).double().mean()) > 0.75:
            return point
    mean = forward.mean(0)
    if float(mean.norm()) < 0.1:  # they look every way, outwards
        return centres.mean(0)
    return centres.mean(0) + distance * mean / mean.norm()


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera with a picture of another size and shape, which shows as much of the scene.

    The pixels are square. As wide a field as before gets another shape: what is won to the sides
    of a picture that becomes wider is lost above and below.
    """
    # The focal length in units of the picture's mean side stays.
    focal = math.sqrt(camera.fx * camera.fy * (width * height) / (camera.width * camera.height))
    return dataclasses.replace(
        camera, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2
    )
