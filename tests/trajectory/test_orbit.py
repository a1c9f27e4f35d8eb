"""Ellipses, spirals, orbits: closed, constant speed, looking at the focus, without roll."""

import math

import pytest
import torch

from snowsplat.trajectory import ellipse_path, orbit_path, spiral_path
from snowsplat.util.errors import UserError

from .rigs import FOCUS, UP, camera_at, misses, positions, ring, rolls, speeds, turns, wall


def check_closed_path(path, frames):
    assert len(path) == frames
    steps = speeds(path, closed=True)
    assert float(steps.max() / steps.min()) < 1.04  # constant, also from the last to the first
    assert float(turns(path, closed=True).max()) < 3 * 2 * math.pi / frames
    assert float(rolls(path).abs().max()) < 1e-9
    assert all(float(camera.cam_from_world[1, :3] @ UP) < 0 for camera in path)  # upper edge is up


def test_ellipse_of_cameras_that_surround_the_focus():
    path = ellipse_path(ring(24), 60, 3.5)
    check_closed_path(path, 60)
    assert float(misses(path, FOCUS).max()) < 1e-6
    offsets = positions(path) - FOCUS
    torch.testing.assert_close(offsets[:, 1], torch.full((60,), -1.0).double())
    on_ellipse = (offsets[:, 0] / 4).square() + (offsets[:, 2] / 3).square()
    torch.testing.assert_close(on_ellipse, torch.ones(60).double(), atol=0.06, rtol=0)
    # It starts at the first camera.
    assert float((path[0].position - ring(24)[0].position).norm()) < 0.1


def test_ellipse_stays_near_the_cameras_if_most_are_on_one_side():
    path = ellipse_path([*ring(8, 3.0, 3.0), *ring(40, 3.0, 3.0, turn=1.0)], 50, 3.0)
    check_closed_path(path, 50)
    radii = (positions(path) - FOCUS)[:, [0, 2]].norm(dim=1)
    assert 2.9 < float(radii.min()) <= float(radii.max()) < 3.1


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.0, 2.5])
def test_ellipse_stays_within_the_arc_that_cameras_cover(turn):
    """It does not show the focus from directions that no camera has seen."""
    cameras = ring(20, 4.0, 4.0, turn)
    path = ellipse_path(cameras, 300, math.hypot(4.0, 1.0))
    check_closed_path(path, 300)
    offsets = positions(path) - FOCUS
    assert float(misses(path, FOCUS).max()) < 1.0
    middle = (positions(cameras) - FOCUS).mean(0)
    if turn:
        cosines = offsets @ middle / offsets.norm(dim=1) / middle.norm()
        assert float(cosines.min()) > math.cos(max(turn / 2, 0.06) + 0.3)


def test_outliers_do_not_move_the_focus():
    odd = [camera_at((9.0, 0.0, 0.0), torch.tensor([9.0, 5.0, 5.0]).double())]
    path = ellipse_path([*ring(24), *odd], 30, 3.5)
    assert float(misses(path, FOCUS).max()) < 1.0


def test_a_dataset_that_is_not_oriented():
    """As COLMAP writes it: the up direction is estimated from the cameras."""
    up = torch.nn.functional.normalize(torch.tensor([0.5, 0.3, 1.0]), dim=0).double()
    east = torch.nn.functional.normalize(torch.linalg.cross(up, UP), dim=0)
    north = torch.linalg.cross(up, east)
    cameras = [
        camera_at((3 * math.cos(t) * east + 3 * math.sin(t) * north + up).tolist(), 0 * up, up)
        for t in torch.linspace(0, 6, 24).tolist()
    ]
    path = ellipse_path(cameras, 30, 3.0)
    assert float(rolls(path, up).abs().max()) < 1e-4
    assert float((positions(path) @ up - 1).abs().max()) < 1e-3


def test_cameras_that_look_straight_down():
    grid = [
        camera_at((0.5 * i, -4.0, 0.5 * j), torch.tensor([0.5 * i, 0.0, 0.5 * j]).double())
        for i in range(5)
        for j in range(5)
    ]
    path = ellipse_path(grid, 30, 4.0)
    steps = speeds(path, closed=True)
    assert float(steps.max() / steps.min()) < 1.02
    assert float((positions(path)[:, 1] + 4.0).abs().max()) < 1.0


def test_spiral_stays_within_cameras_that_look_in_one_direction():
    cameras = wall()
    path = spiral_path(cameras, 240, 5.0)
    check_closed_path(path, 240)
    places, given = positions(path), positions(cameras)
    inside = (places[:, :2] >= given[:, :2].min(0).values - 0.06) & (
        places[:, :2] <= given[:, :2].max(0).values + 0.06
    )
    assert bool(inside.all())
    # The spiral reaches both sides of the middle and passes through it.
    offsets = places[:, :2] - given[:, :2].mean(0)
    assert float(offsets.min()) < -0.2 < 0.2 < float(offsets.max())
    assert float(offsets.norm(dim=1).min()) < 0.01
    focus = torch.tensor([0.5, 0.225, 5.0]).double()
    assert float(misses(path, focus).max()) < 2.0


def test_spiral_is_rejected_if_cameras_look_in_all_directions():
    above = [camera_at((3 * math.cos(t), -3.0, 3 * math.sin(t))) for t in range(12)]
    for cameras in (ring(12), above):
        with pytest.raises(UserError, match="use an ellipse"):
            spiral_path(cameras, 10, 3.0)


def test_orbit_surrounds_most_of_the_points():
    random = torch.Generator().manual_seed(0)
    thing = FOCUS.float() + 0.2 * torch.randn(1000, 3, generator=random)
    faint = 50 * torch.randn(3000, 3, generator=random)
    weights = torch.cat([torch.ones(1000), torch.full((3000,), 0.01)])
    path = orbit_path(torch.cat([thing, faint]), weights, 40, 64, 48)
    check_closed_path(path, 40)
    assert float(misses(path, FOCUS).max()) < 3.0
    distances = (positions(path) - FOCUS).norm(dim=1)
    assert 0.5 < float(distances.min()) <= float(distances.max()) < 2.0
    with pytest.raises(UserError, match="no Gaussians"):
        orbit_path(torch.zeros(0, 3), torch.zeros(0), 40, 64, 48)


def test_one_camera_and_one_frame_are_enough():
    assert len(ellipse_path(ring(1), 12, 3.0)) == 12
    assert len(spiral_path(ring(1), 12, 3.0)) == 12
    assert len(ellipse_path(ring(9), 1, 3.0)) == 1
