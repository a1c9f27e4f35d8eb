"""The formulas of docs/learn/camera.md."""

import math

import pytest
import torch

from snowsplat import Camera
from snowsplat.scene.geometry import look_at


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


POSE = look_at(vector(1, -2, -3), vector(0.2, 0.1, 0.3), vector(0, -1, 0))
CAMERA = Camera(64, 48, 50.0, 52.0, 30.0, 25.0, POSE)
POINTS = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.5


def test_the_chain_is_that_of_the_code():
    W, t = POSE[:, :3], POSE[:, 3]
    m, depth = CAMERA.project(POINTS)
    for mu, found, z_found in zip(POINTS, m, depth, strict=True):
        x, y, z = W @ mu + t
        expected = vector(50 * x / z + 30, 52 * y / z + 25)
        assert torch.allclose(found, expected)
        assert z_found == pytest.approx(float(z))


def test_the_position_of_the_camera():
    W, t = POSE[:, :3], POSE[:, 3]
    assert torch.allclose(-W.T @ t, vector(1, -2, -3))
    assert torch.allclose(CAMERA.position, -W.T @ t)


def test_clip_coordinates_and_viewport_are_the_same_chain():
    w, h = CAMERA.width, CAMERA.height
    matrix = torch.tensor(
        [
            [2 * CAMERA.fx / w, 0, 2 * CAMERA.cx / w - 1],
            [0, 2 * CAMERA.fy / h, 2 * CAMERA.cy / h - 1],
            [0, 0, 1],
        ],
        dtype=torch.float64,
    )
    p = POINTS @ POSE[:, :3].T + POSE[:, 3]
    clip = p @ matrix.T
    n = clip[:, :2] / clip[:, 2:]
    m = (n + 1) * vector(w / 2, h / 2)
    assert torch.allclose(m, CAMERA.project(POINTS)[0])


def test_the_field_of_view():
    fx = 64 / (2 * math.tan(math.radians(60) / 2))
    camera = Camera(64, 48, fx, fx, 32.0, 24.0, torch.eye(3, 4, dtype=torch.float64))
    edge = vector(math.tan(math.radians(30)), 0, 1)[None]
    assert camera.project(edge)[0][0].tolist() == pytest.approx([64, 24])


def test_resizing_scales_all_positions():
    half = CAMERA.scaled(32, 24)
    assert (half.fx, half.fy, half.cx, half.cy) == (25.0, 26.0, 15.0, 12.5)
    assert torch.allclose(half.project(POINTS)[0], CAMERA.project(POINTS)[0] / 2)


def test_exercises():
    fx = 4000 / (2 * math.tan(math.radians(67) / 2))
    assert (fx, fx / 4) == (pytest.approx(3022, abs=1), pytest.approx(755, abs=1))
    # The OpenGL axes: y and z have the opposite signs, in rows of cam_from_world.
    flip = torch.diag(vector(1, -1, -1))
    square = torch.cat([POSE, vector(0, 0, 0, 1)[None]])
    opengl = torch.cat([flip @ POSE, vector(0, 0, 0, 1)[None]])
    world_from_cam = torch.linalg.inv(opengl)
    world_from_cam[:, 1:3] *= -1
    assert torch.allclose(torch.linalg.inv(world_from_cam), square)
    # Twice the focal length enlarges the image about the principal point.
    longer = Camera(64, 48, 100.0, 104.0, 30.0, 25.0, POSE)
    c = vector(30, 25)
    assert torch.allclose(longer.project(POINTS)[0], 2 * (CAMERA.project(POINTS)[0] - c) + c)
