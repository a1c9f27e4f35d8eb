"""The up direction from synthetic cameras. For complete models see tests/sfm/test_orient.py."""

import math

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.scene.orientation import up_direction

UP = torch.nn.functional.normalize(torch.tensor([0.2, -0.9, 0.3], dtype=torch.float64), dim=0)


def rotations(pitch: float, roll: float, sector: float) -> np.ndarray:
    """30 cameras on an arc of ``sector`` radians around a point.

    They look down by ``pitch``; their roll is random with the standard deviation ``roll``.
    """
    random = np.random.default_rng(0)
    east = torch.linalg.cross(UP, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    east = east / east.norm()
    north = torch.linalg.cross(UP, east)
    found = []
    for azimuth in np.linspace(0, sector, 30):
        place = math.cos(azimuth) * east + math.sin(azimuth) * north + math.tan(pitch) * UP
        level = look_at(place, 0 * UP, UP)[:, :3].numpy()
        turn = random.normal(0, roll)
        c, s = math.cos(turn), math.sin(turn)
        found.append(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ level)
    return np.stack(found)


@pytest.mark.parametrize("pitch", [0.0, 0.5, 1.0])
def test_cameras_on_a_circle_look_down(pitch):
    up = up_direction(rotations(pitch, 0.0, 6.0))
    assert float(up @ UP.numpy()) > math.cos(math.radians(0.5))


def test_cameras_on_an_arc_with_random_roll():
    up = up_direction(rotations(0.3, math.radians(3), 2.0))
    assert float(up @ UP.numpy()) > math.cos(math.radians(3))


def test_photos_rolled_by_90_degrees_have_little_weight():
    some = rotations(0.3, math.radians(2), 6.0)
    some[::4] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ some[::4]
    assert float(up_direction(some) @ UP.numpy()) > math.cos(math.radians(3))


@pytest.mark.parametrize("sector", [0.05, 0.5, 3.0])
def test_the_result_is_the_most_likely_direction(sector):
    """It is more likely than the directions near it.

    The roll r has the density (σ² + (r/3)²)^(-9/2); the mean pitch is normally distributed.
    The log-likelihood of ``up`` is −9/2 Σ log(σ² + (x·up / 3)²) + mean·up / σ_pitch².
    """
    found = rotations(0.4, math.radians(4), sector)
    mean = -found[:, 1].mean(axis=0)

    def cost(up: np.ndarray) -> float:
        roll = found[:, 0] @ up
        spread = math.radians(3) ** 2 + (roll / 3) ** 2
        return float(4.5 * np.log(spread).sum() - mean @ up / math.radians(30) ** 2)

    up = up_direction(found)
    across = np.linalg.svd(up[None])[2][1:]
    for angle in np.linspace(0, 2 * math.pi, 12):
        other = up + 1e-3 * (math.cos(angle) * across[0] + math.sin(angle) * across[1])
        assert cost(other / np.linalg.norm(other)) > cost(up)
    assert float(np.linalg.norm(up)) == pytest.approx(1)
