"""Orientation, centre and scale for typical ways of taking photos, in an arbitrary SfM frame."""

import math
from pathlib import Path

import pycolmap
import pytest
import torch

from snowsplat.scene.geometry import Similarity, invert_rigid, look_at, rotation_from_quat
from snowsplat.scene.orientation import VIEWING_DISTANCE
from snowsplat.sfm.orient import orientation

F64 = torch.float64
UP = torch.tensor([0.0, -1.0, 0.0], dtype=F64)
CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


# An arbitrary frame, as SfM returns one.
SFM = Similarity(
    0.37, rotation_from_quat(normal(4, seed=5)), torch.tensor([4.0, 5.0, -6.0], dtype=F64)
)


def cameras_at(centres: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    targets = targets.expand_as(centres)
    return torch.stack([look_at(c, t, UP) for c, t in zip(centres, targets, strict=True)])


def rolled(poses: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    half = torch.deg2rad(degrees) / 2
    zero = torch.zeros_like(half)
    return rotation_from_quat(torch.stack([half.cos(), zero, zero, half.sin()], -1)) @ poses


def ring(count: int, height: float, arc: float = 360.0) -> torch.Tensor:
    angles = torch.deg2rad(torch.arange(count, dtype=F64) * arc / count)
    return torch.stack([4 * angles.sin(), torch.full_like(angles, -height), -4 * angles.cos()], -1)


def oriented(model_of, poses: torch.Tensor, points: torch.Tensor) -> Similarity:
    """``scene_from_true``: the estimated scene frame relative to the true one, which has y down."""
    model = model_of(SFM.apply_to_poses(poses), SFM.apply(points))
    found = orientation(model).scene_from_sfm
    rotation = found.rotation @ SFM.rotation
    shift = found.apply(SFM.apply(torch.zeros(1, 3, dtype=F64)))[0]
    return Similarity(found.scale * SFM.scale, rotation, shift)


def tilt(similarity: Similarity) -> float:
    """Angle in degrees between the true and the estimated up direction."""
    return math.degrees(math.acos(min(1.0, float(similarity.rotation[1, 1]))))


@pytest.mark.parametrize("height", [0.0, 1.5, 6.0])
def test_a_ring_around_an_object(model_of, height):
    centres = ring(24, height)
    found = oriented(model_of, cameras_at(centres, 0 * UP), 0.4 * normal(300, 3))
    assert tilt(found) < 0.01
    assert found.translation.norm() < 0.05  # the object is at the centre
    distance = found.apply(centres).norm(dim=1)
    assert torch.allclose(distance, torch.full_like(distance, VIEWING_DISTANCE), rtol=0.03)
    assert found.rotation[2, 2] == pytest.approx(1)  # the first camera looks along +z


def test_photos_from_above_are_not_mistaken_for_level_ones(model_of):
    centres = ring(20, 4.0, arc=80)
    poses = rolled(cameras_at(centres, 0 * UP), 3 * normal(20))
    assert tilt(oriented(model_of, poses, 0.4 * normal(300, 3))) < 2.5


@pytest.mark.parametrize("roll", [30.0, 90.0, 180.0])
def test_some_rolled_photos_change_little(model_of, roll):
    degrees = 2 * normal(40)
    degrees[::5] += roll
    poses = rolled(cameras_at(ring(40, 1.5), 0 * UP), degrees)
    assert tilt(oriented(model_of, poses, 0.4 * normal(300, 3))) < 1.5


def test_photos_of_a_wall(model_of):
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 5), torch.linspace(-0.6, 0.6, 4)).double()
    centres = torch.cat([grid, -5 + 0 * grid[:, :1]], 1)
    poses = rolled(cameras_at(centres, centres + torch.tensor([0, 0, 1.0])), normal(20))
    wall = normal(400, 3) * torch.tensor([2, 1.5, 0.1])
    found = oriented(model_of, poses, wall)
    assert tilt(found) < 1.5
    assert found.rotation[2, 2] > 0.999  # the cameras look along +z
    assert found.apply(wall).median(0).values.norm() < 0.3
    assert found.apply(centres)[:, 2].median() == pytest.approx(-VIEWING_DISTANCE, rel=0.15)


def test_a_room_seen_from_its_centre(model_of):
    outward = ring(30, 0.5) / 4
    poses = rolled(cameras_at(0.3 * outward, 2 * outward + 0.2 * normal(30, 3)), 3 * normal(30))
    directions = normal(2000, 3)
    walls = 4 * directions / directions.abs().amax(1, keepdim=True)
    found = oriented(model_of, poses, walls)
    assert tilt(found) < 1.5
    assert found.translation.norm() < 0.5
    assert 0.5 * VIEWING_DISTANCE < 4 * found.scale < 1.5 * VIEWING_DISTANCE


def test_aerial_photos_looking_straight_down(model_of):
    grid = torch.cartesian_prod(torch.arange(5), torch.arange(4)).double()
    centres = torch.stack([grid[:, 0] - 2, -10 + 0 * grid[:, 0], grid[:, 1] - 1.5], 1)
    straight_down = cameras_at(centres, centres - UP)
    ground = normal(500, 3) * torch.tensor([4, 0.1, 4])
    # Parallel lanes in alternating directions, then random rotations.
    turns = 360 * torch.rand(8, 20, dtype=F64, generator=torch.Generator().manual_seed(0))
    for degrees in (180 * (grid[:, 0] % 2), *turns):
        found = oriented(model_of, rolled(straight_down, degrees), ground)
        assert tilt(found) < 3
        assert found.apply(ground).median(0).values.norm() < 0.5


def test_a_forward_walk(model_of):
    centres = torch.stack([torch.zeros(20), torch.zeros(20), torch.arange(20) * 0.5], 1).double()
    wobble = 0.1 * normal(20, 3)
    poses = rolled(cameras_at(centres, centres + torch.tensor([0, 0, 1.0]) + wobble), normal(20))
    points = normal(800, 3, seed=2) * torch.tensor([2, 1, 4]) + torch.tensor([0, 0, 10.0])
    found = oriented(model_of, poses, points)
    assert tilt(found) < 6  # one viewing direction: a common pitch cannot be detected
    assert found.rotation[2, 2] > 0.99
    assert found.apply(points).median(0).values.norm() < 1


def test_without_points_the_camera_positions_determine_the_scale(model_of):
    found = oriented(model_of, cameras_at(ring(12, 1.0), 0 * UP), torch.zeros(0, 3, dtype=F64))
    assert tilt(found) < 0.01
    assert found.translation.norm() < 0.05
    assert 0.3 * VIEWING_DISTANCE < 4 * found.scale < 3 * VIEWING_DISTANCE


def test_one_camera_and_no_camera(model_of):
    points = torch.tensor([0, 0, 4.0]) + 0.3 * normal(50, 3)
    pose = cameras_at(torch.zeros(1, 3, dtype=F64), torch.tensor([0, 0, 1.0], dtype=F64))
    found = oriented(model_of, pose, points)
    assert torch.allclose(found.rotation, torch.eye(3, dtype=F64), atol=1e-6)
    with pytest.raises(ValueError, match="without cameras"):
        orientation(model_of(pose[:0], points[:0]))


@pytest.mark.parametrize("name", ["fox", "fern", "kitchen25"])
def test_real_datasets_are_upright(name):
    folder = CAPTURES / name / "sparse" / "0"
    if not folder.is_dir():
        pytest.skip(f"no real dataset at ../shared/captures/{name}")
    model = pycolmap.Reconstruction(folder)
    found = orientation(model).scene_from_sfm
    poses = torch.stack(
        [torch.from_numpy(image.cam_from_world().matrix()) for image in model.images.values()]
    )
    moved = found.apply_to_poses(poses)
    # Photos are level: for most, x is within 6 degrees of the horizontal, and y points down.
    assert moved[:, 0, 1].abs().median() < 0.1
    assert moved[:, 1, 1].median() > 0.5
    # The origin is in front of nearly all cameras.
    depth = moved[:, 2, 3]
    assert (depth > 0).double().mean() > 0.9
    assert invert_rigid(moved)[:, :, 3].norm(dim=1).median() == pytest.approx(3, rel=0.5)
