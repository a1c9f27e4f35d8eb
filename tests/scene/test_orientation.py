"""The up direction from synthetic cameras. For complete models see tests/sfm/orient."""

import math

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at, rotation_from_quat
from snowsplat.scene.orientation import level_of_cameras, scene_up, up_of_surfaces

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
    up = level_of_cameras(rotations(pitch, 0.0, 6.0))[0]
    assert float(up @ UP.numpy()) > math.cos(math.radians(0.5))


def test_cameras_on_an_arc_with_random_roll():
    up = level_of_cameras(rotations(0.3, math.radians(3), 2.0))[0]
    assert float(up @ UP.numpy()) > math.cos(math.radians(3))


def test_photos_rolled_by_90_degrees_have_little_weight():
    some = rotations(0.3, math.radians(2), 6.0)
    some[::4] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ some[::4]
    assert float(level_of_cameras(some)[0] @ UP.numpy()) > math.cos(math.radians(3))


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

    up = level_of_cameras(found)[0]
    across = np.linalg.svd(up[None])[2][1:]
    for angle in np.linspace(0, 2 * math.pi, 12):
        other = up + 1e-3 * (math.cos(angle) * across[0] + math.sin(angle) * across[1])
        assert cost(other / np.linalg.norm(other)) > cost(up)
    assert float(np.linalg.norm(up)) == pytest.approx(1)


def surfaces(ground: int, random: int, up: torch.Tensor) -> np.ndarray:
    """Normals of ``ground`` surfaces perpendicular to ``up``, with noise, and of random ones."""
    generator = torch.Generator().manual_seed(0)
    sign = torch.where(torch.rand(ground, 1, generator=generator) < 0.5, -1.0, 1.0)
    level = sign * (up + 0.03 * torch.randn(ground, 3, generator=generator))
    others = torch.randn(random, 3, generator=generator)
    return torch.nn.functional.normalize(torch.cat([level, others]).double(), dim=1).numpy()


def somewhere(count: int) -> np.ndarray:
    """Random positions."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3))


@pytest.mark.parametrize("tilt", [0.0, 15.0, 35.0])
def test_the_ground_implies_the_up_direction(tilt):
    """A larger wall does not, because it is vertical."""
    angle = math.radians(tilt)
    up = torch.tensor([math.sin(angle), -math.cos(angle), 0.0])
    wall = surfaces(1000, 0, torch.tensor([0.0, 0.0, 1.0]))
    normals = np.concatenate([surfaces(500, 1500, up), wall])
    found = up_of_surfaces(normals, np.ones(len(normals)), somewhere(len(normals)))
    assert found is not None
    assert np.degrees(np.arccos(found @ up.numpy())) < 1
    areas = np.ones(len(normals))
    areas[:500] = 0.1  # now the ground is only a small part
    assert up_of_surfaces(normals, areas, somewhere(len(normals))) is None


def test_surfaces_that_imply_no_up_direction():
    assert up_of_surfaces(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))) is None
    assert up_of_surfaces(surfaces(0, 3000, UP.float()), np.ones(3000), somewhere(3000)) is None
    steep = surfaces(1000, 0, torch.tensor([math.sin(0.9), -math.cos(0.9), 0.0]))
    assert up_of_surfaces(steep, np.ones(1000), somewhere(1000)) is None


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_an_object_on_a_plate_at_the_lowest_z_has_z_up(end):
    """A wall behind the subject is at the highest z, seen by cameras that look along z."""
    plate, rest = surfaces(500, 0, torch.tensor([0.0, 0.0, 1.0])), surfaces(0, 3000, UP.float())
    positions = somewhere(3500)
    positions[:500, 2] = end
    found = up_of_surfaces(np.concatenate([plate, rest]), np.ones(3500), positions)
    if end < 0:
        assert found is not None
        assert found.tolist() == [0.0, 0.0, 1.0]
    else:
        assert found is None


MINUS_Y = np.array([0.0, -1.0, 0.0])


def turned(found, axis=0, degrees=0.0):
    """The cameras in a frame in which up is −y, turned about one of its axes."""
    east = np.cross(UP.numpy(), [1.0, 0.0, 0.0])
    east /= np.linalg.norm(east)
    level_from_world = np.stack([east, -UP.numpy(), np.cross(east, -UP.numpy())])
    angle = torch.tensor(math.radians(degrees) / 2)
    quat = torch.zeros(4, dtype=torch.float64)
    quat[0], quat[1 + axis] = angle.cos(), angle.sin()
    return found @ level_from_world.T @ rotation_from_quat(quat).numpy()


def angle_to_minus_y(up):
    return math.degrees(math.acos(min(1.0, float(up @ MINUS_Y))))


@pytest.mark.parametrize("pitch", [0.0, 0.8])
def test_a_scene_keeps_its_up_direction_if_most_cameras_are_level(pitch):
    np.testing.assert_array_equal(scene_up(turned(rotations(pitch, 0.02, 0.1))), MINUS_Y)


def test_a_scene_turns_as_far_as_its_cameras_are_certain():
    """Cameras on a circle are certain about roll and pitch, parallel ones only about the roll."""
    circle, wall = rotations(0.3, 0.02, 6.0), rotations(0.0, 0.02, 0.01)
    for axis in (0, 2):
        assert angle_to_minus_y(scene_up(turned(circle, axis, 20.0))) == pytest.approx(20, abs=2)
    facing = next(axis for axis in (0, 2) if abs(turned(wall)[0, 2, axis]) > 0.7)
    np.testing.assert_array_equal(scene_up(turned(wall, 2 - facing, 20.0)), MINUS_Y)
    assert angle_to_minus_y(scene_up(turned(wall, facing, 20.0))) == pytest.approx(20, abs=3)
    # The usual frame of synthetic scenes, in which z is up.
    assert angle_to_minus_y(scene_up(turned(wall, 0, 90.0))) > 80
