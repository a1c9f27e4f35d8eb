"""Cameras where nobody took a photo."""

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.training.parts.limits import beside

TARGET = torch.zeros(3, dtype=torch.float64)
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def camera(*position: float) -> Camera:
    pose = look_at(torch.tensor(position, dtype=torch.float64), TARGET, UP)
    return Camera(40, 30, 30.0, 30.0, 20.0, 15.0, pose)


FIRST, SECOND = camera(0.0, 0.0, -4.0), camera(1.0, 0.5, -4.0)


@pytest.mark.parametrize("share", [-0.5, 0.25, 0.5])
def test_an_unseen_camera_is_on_the_line_through_two_cameras(share):
    moved = beside(FIRST, SECOND, share)
    expected = (1.0 + share) * FIRST.position - share * SECOND.position
    assert torch.allclose(moved.position, expected, atol=1e-9)
    rotation = moved.cam_from_world[:, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3).double(), atol=1e-9)
    assert torch.det(rotation) > 0
    assert (moved.width, moved.fx, moved.cx) == (FIRST.width, FIRST.fx, FIRST.cx)


def test_the_direction_changes_with_the_position():
    one, middle, other = (
        c.cam_from_world[2, :3] for c in (beside(FIRST, SECOND, 0.5), FIRST, SECOND)
    )
    assert one @ middle > one @ other


def test_no_share_and_all_of_it():
    assert torch.allclose(beside(FIRST, SECOND, 0.0).cam_from_world, FIRST.cam_from_world)
    assert torch.allclose(beside(FIRST, SECOND, -1.0).cam_from_world, SECOND.cam_from_world)


def test_opposite_directions_give_a_rotation():
    moved = beside(FIRST, camera(0.0, 0.0, 4.0), -0.5)
    assert torch.det(moved.cam_from_world[:, :3]) == pytest.approx(1.0)
