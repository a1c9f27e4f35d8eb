"""Arrangements of cameras as in datasets, and measurements of camera paths."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
FOCUS = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)


def camera_at(position: Sequence[float], target: Tensor = FOCUS, up: Tensor = UP) -> Camera:
    place = torch.tensor(position, dtype=torch.float64)
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, look_at(place, target, up))


def ring(count: int, a: float = 4.0, b: float = 3.0, turn: float = 2 * math.pi) -> list[Camera]:
    """Cameras on an ellipse around the focus, 1 above it, over an angle of ``turn`` radians."""
    angles = [turn * i / count for i in range(count)]
    x, y, z = FOCUS.tolist()
    return [camera_at((x + a * math.cos(t), y - 1.0, z + b * math.sin(t))) for t in angles]


def wall(columns: int = 6, rows: int = 4) -> list[Camera]:
    """A grid of parallel cameras, row by row."""
    return [
        camera_at((0.2 * i, 0.15 * j, 0.0), torch.tensor([0.2 * i, 0.15 * j, 5.0]).double())
        for j in range(rows)
        for i in range(columns)
    ]


def positions(cameras: Sequence[Camera]) -> Tensor:
    return torch.stack([camera.position for camera in cameras])


def speeds(cameras: Sequence[Camera], closed: bool) -> Tensor:
    places = positions(cameras)
    return (torch.cat([places, places[:1]]) if closed else places).diff(dim=0).norm(dim=1)


def turns(cameras: Sequence[Camera], closed: bool) -> Tensor:
    """Rotation angles between neighbouring cameras in radians."""
    rotations = torch.stack([camera.cam_from_world[:, :3] for camera in cameras])
    following = rotations.roll(-1, 0)
    traces = (rotations * following).sum((1, 2))
    angles = torch.acos(((traces - 1) / 2).clamp(-1, 1))
    return angles if closed else angles[:-1]


def rolls(cameras: Sequence[Camera], up: Tensor = UP) -> Tensor:
    """Sines of the roll angles of the cameras."""
    return torch.stack([camera.cam_from_world[0, :3] @ up for camera in cameras])


def misses(cameras: Sequence[Camera], target: Tensor) -> Tensor:
    """Distances in pixels from the middle of the image to the projection of ``target``."""
    seen = [camera.project(target[None]) for camera in cameras]
    assert all(float(depth[0]) > 0 for _, depth in seen)
    middle = torch.tensor([cameras[0].cx, cameras[0].cy], dtype=torch.float64)
    return torch.stack([(pixel[0] - middle).norm() for pixel, _ in seen])
