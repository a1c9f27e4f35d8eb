"""The formulas of docs/learn/structure-from-motion.md."""

import math

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import rotation_from_quat

RNG = np.random.default_rng(0)
R = rotation_from_quat(torch.tensor([[0.9, 0.1, -0.2, 0.15]], dtype=torch.float64))[0].numpy()
T = np.array([0.4, -0.1, 0.2])
POINTS = np.array([0, 0, 4]) + RNG.normal(0, 0.7, (20, 3))  # in the first camera


def cross(t: np.ndarray) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def rays(points: np.ndarray) -> np.ndarray:
    return points / points[:, 2:]


def test_the_essential_matrix_is_zero_between_rays_of_a_point():
    x1, x2 = rays(POINTS), rays(POINTS @ R.T + T)
    essential = cross(T) @ R
    assert np.abs(np.einsum("ni,ij,nj->n", x2, essential, x1)).max() < 1e-14
    assert np.allclose(cross(T) @ x1[0], np.cross(T, x1[0]))
    # The length of t is lost, and a wrong match has another value.
    assert np.abs(np.einsum("ni,ij,nj->n", x2, cross(3 * T) @ R, x1)).max() < 1e-13
    assert np.abs(np.einsum("ni,ij,nj->n", x2[::-1], essential, x1)).max() > 1e-3


def test_the_epipolar_line_is_the_image_of_a_ray():
    x1 = rays(POINTS)[0]
    line = cross(T) @ R @ x1
    for depth in (1.0, 2.0, 9.0):
        on_ray = rays((depth * x1 @ R.T + T)[None])[0]
        assert abs(line @ on_ray) < 1e-14


def test_triangulation_is_linear():
    x1, x2 = rays(POINTS)[3], rays(POINTS @ R.T + T)[3]
    rows = []
    for P, (u, v, _) in ((np.eye(3, 4), x1), (np.column_stack([R, T]), x2)):
        rows += [u * P[2] - P[0], v * P[2] - P[1]]
    equations = np.array(rows)
    found, *_ = np.linalg.lstsq(equations[:, :3], -equations[:, 3], rcond=None)
    assert np.allclose(found, POINTS[3])


@pytest.mark.parametrize(
    ("share", "size", "count"), [(0.5, 5, 146), (0.25, 5, 4714), (0.25, 3, 293)]
)
def test_the_number_of_samples(share, size, count):
    assert math.ceil(math.log(1 - 0.99) / math.log(1 - share**size)) == count
    assert 1 - (1 - share**size) ** count >= 0.99 > 1 - (1 - share**size) ** (count - 1)


def test_the_error_of_the_depth_grows_with_its_square():
    f, b, epsilon = 525.0, 0.4, 0.1

    def error(z: float) -> float:
        return abs(f * b / (f * b / z + epsilon) - z)

    assert error(4.0) == pytest.approx(0.0076, abs=1e-4)
    assert error(4.0) == pytest.approx(4.0**2 * epsilon / (f * b), rel=0.01)
    assert error(40.0) == pytest.approx(0.76, rel=0.03)


def test_a_larger_scene_has_the_same_images():
    moved = (POINTS @ R.T + T)[:, :2] / (POINTS @ R.T + T)[:, 2:]
    larger = 7 * POINTS @ R.T + 7 * T
    assert np.allclose(larger[:, :2] / larger[:, 2:], moved)
