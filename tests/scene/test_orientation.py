"""Up, from how cameras are held; with whole models: tests/sfm/test_orient.py."""

import math

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.scene.orientation import up_direction

UP = torch.nn.functional.normalize(torch.tensor([0.2, -0.9, 0.3], dtype=torch.float64), dim=0)


def rotations(pitch: float, roll: float, sector: float) -> np.ndarray:
    """Cameras around a point, that look down by ``pitch`` and are rolled at random."""
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
def test_cameras_all_around_look_down_together(pitch):
    up = up_direction(rotations(pitch, 0.0, 6.0))
    assert float(up @ UP.numpy()) > math.cos(math.radians(0.5))


def test_a_part_of_the_circle_and_hands_that_shake():
    up = up_direction(rotations(0.3, math.radians(3), 2.0))
    assert float(up @ UP.numpy()) > math.cos(math.radians(3))


def test_photos_held_sideways_have_little_say():
    some = rotations(0.3, math.radians(2), 6.0)
    some[::4] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ some[::4]
    assert float(up_direction(some) @ UP.numpy()) > math.cos(math.radians(3))
