"""Ellipses, spirals, orbits: closed, constant speed, looking at the focus, without roll."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
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


def test_orbit_is_a_circle_at_three_times_the_median_distance():
    """The circle is 15° above the middle. It starts in front of the scene and goes to the right."""
    focus = torch.tensor([1.0, 2.0, 3.0])
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    # Weighted, the median distance is 2: without weights it would be 50.
    points = torch.cat([focus + 2 * axes, focus + 50 * axes.repeat(3, 1), focus[None]])
    weights = torch.cat([torch.ones(6), torch.full((18,), 0.01), torch.ones(1)])
    path = orbit_path(points, weights, 8, 96, 64)
    radius = 3 * 2 * math.cos(math.radians(15))
    for i, camera in enumerate(path):
        angle = 2 * math.pi * i / 8
        expected = (
            1 + radius * math.sin(angle),
            2 - 6 * math.sin(math.radians(15)),
            3 - radius * math.cos(angle),
        )
        assert camera.position.tolist() == pytest.approx(expected, abs=2e-3)
        assert (camera.width, camera.height, camera.cx, camera.cy) == (96, 64, 48, 32)
        assert camera.fx == camera.fy == pytest.approx(1.2 * 64)
    assert float(misses(path, focus.double()).max()) < 1e-9
    assert orbit_path(points, weights, 1, 64, 96)[0].fx == pytest.approx(1.2 * 64)


def test_orbit_of_a_single_point():
    (camera,) = orbit_path(torch.ones(1, 3), torch.ones(1), 1, 64, 48)
    assert math.dist(camera.position.tolist(), (1, 1, 1)) == pytest.approx(3.0)


def azimuths(path: list[Camera]) -> torch.Tensor:
    offsets = positions(path) - FOCUS
    return torch.atan2(offsets[:, 2], offsets[:, 0])


def elevations(path: list[Camera]) -> torch.Tensor:
    offsets = positions(path) - FOCUS
    return torch.atan2(-offsets[:, 1], offsets[:, [0, 2]].norm(dim=1))


@pytest.mark.parametrize("turn", [1.0, 3.0])
def test_an_oval_covers_the_range_of_the_cameras(turn):
    """10% of the cameras at each end are ignored. The height is at least a quarter of the width."""
    cameras = ring(21, 4.0, 4.0, turn)
    path = ellipse_path(cameras, 400, math.hypot(4.0, 1.0))
    middle, swing = turn * 20 / 21 / 2, turn * 20 / 21 / 2 * 0.8
    assert float(azimuths(path).min()) == pytest.approx(middle - swing, abs=2e-3)
    assert float(azimuths(path).max()) == pytest.approx(middle + swing, abs=2e-3)
    level = math.atan2(1.0, 4.0)
    rise = max(math.radians(2), swing / 4)
    assert float(elevations(path).min()) == pytest.approx(level - rise, abs=2e-3)
    assert float(elevations(path).max()) == pytest.approx(level + rise, abs=2e-3)
    distances = (positions(path) - FOCUS).norm(dim=1)
    torch.testing.assert_close(distances, torch.full((400,), math.hypot(4.0, 1.0)).double())


def test_an_oval_is_in_the_middle_of_the_outer_cameras():
    """If most cameras are on one side, the middle of the 10% and 90% quantiles is used."""
    cameras = [*ring(31, 4.0, 4.0, 2.0), *ring(30, 4.0, 4.0, 0.2)]
    given = azimuths(cameras)
    low, high = torch.quantile(given, torch.tensor([0.1, 0.9]).double()).tolist()
    path = ellipse_path(cameras, 400, math.hypot(4.0, 1.0))
    assert float(azimuths(path).min()) == pytest.approx(low, abs=2e-3)
    assert float(azimuths(path).max()) == pytest.approx(high, abs=2e-3)


def test_an_oval_of_one_camera_swings_by_two_degrees():
    path = ellipse_path([camera_at((FOCUS[0] + 4.0, FOCUS[1], FOCUS[2]))], 400, 4.0)
    least = math.radians(2)
    for angles in (azimuths(path), elevations(path)):
        assert float(angles.max()) == pytest.approx(least, rel=1e-3)
        assert float(angles.min()) == pytest.approx(-least, rel=1e-3)


def test_an_oval_that_is_high_is_at_least_a_quarter_as_wide_and_not_too_steep():
    angles = torch.linspace(-math.radians(20), math.radians(70), 31).tolist()
    x, y, z = FOCUS.tolist()
    above = [camera_at((x + 4 * math.cos(t), y - 4 * math.sin(t), z)) for t in angles]
    path = ellipse_path(above, 400, 4.0)
    # Without 10% at each end: from −11° to 61°.
    assert float(elevations(path).max()) == pytest.approx(math.radians(61), abs=2e-3)
    assert float(elevations(path).min()) == pytest.approx(math.radians(-11), abs=2e-3)
    assert float(azimuths(path).abs().max()) == pytest.approx(math.radians(9), abs=2e-3)
    steep = [camera_at((x + 4 * math.cos(t), y - 4 * math.sin(t), z)) for t in (1.5, 1.52, 1.54)]
    assert float(elevations(ellipse_path(steep, 100, 4.0)).max()) <= math.radians(80) + 1e-9


@pytest.mark.parametrize(("gap", "surrounds"), [(105, True), (115, False)])
def test_cameras_surround_the_focus_if_no_gap_is_wider_than_110_degrees(gap, surrounds):
    cameras = ring(30, 3.0, 3.0, math.radians(360 - gap) * 30 / 29)
    path = ellipse_path(cameras, 60, 3.0)
    heights = FOCUS[1] - positions(path)[:, 1]
    assert (float(heights.max() - heights.min()) < 1e-9) == surrounds


def test_an_oval_does_not_enter_a_wide_gap():
    """The cameras cover 240°. The oval swings by 80% of that."""
    cameras = ring(30, 3.0, 3.0, math.radians(240) * 30 / 29)
    path = ellipse_path(cameras, 400, math.hypot(3.0, 1.0))
    middle = math.radians(120)
    swings = torch.remainder(azimuths(path) - middle + math.pi, 2 * math.pi) - math.pi
    assert float(swings.max()) == pytest.approx(0.8 * middle, abs=5e-3)
    assert float(swings.min()) == pytest.approx(-0.8 * middle, abs=5e-3)


def test_axes_of_an_ellipse_are_those_of_the_cameras():
    """Turned by 30°: the mean square of a coordinate on an ellipse is half its squared axis."""
    turn = math.radians(30)
    around = torch.arange(40).double() * (2 * math.pi / 40)
    u, v = 4 * around.cos(), 3.5 * around.sin()
    x = FOCUS[0] + math.cos(turn) * u - math.sin(turn) * v
    z = FOCUS[2] + math.sin(turn) * u + math.cos(turn) * v
    y = FOCUS[1].repeat(40) - 1.0
    cameras = [camera_at(place) for place in torch.stack([x, y, z], 1).tolist()]
    path = ellipse_path(cameras, 720, 4.0)
    radii = (positions(path) - FOCUS)[:, [0, 2]].norm(dim=1)
    given = (positions(cameras) - FOCUS)[:, [0, 2]].norm(dim=1)
    low, high = torch.quantile(given, torch.tensor([0.1, 0.9]).double()).tolist()
    assert float(radii.max()) == pytest.approx(min(4.0, high), rel=1e-4)
    assert float(radii.min()) == pytest.approx(max(3.5, low), rel=1e-4)
    widest = azimuths(path)[int(radii.argmax())] % math.pi
    assert float(widest) == pytest.approx(turn, abs=0.02)


def test_spiral_reaches_the_outer_cameras():
    """80% of the cameras are within its radii. The path starts at the middle of the spiral."""
    cameras = wall(21, 11)  # x from 0 to 4, y from 0 to 1.5
    path = spiral_path(cameras, 1000, 5.0)
    places = positions(path) - torch.tensor([2.0, 0.75, 0.0])
    assert float(places[0].norm()) < 1e-6
    # At half of its length, the path is above the middle of the spiral by the radius in y, 0.6. In
    # x it reaches sin(0.4 π) of the radius, 1.6.
    assert float(places[500, 1]) == pytest.approx(-0.6, rel=0.01)
    assert float(places[:, 1].abs().max()) == pytest.approx(0.6, rel=0.01)
    assert float(places[:, 0].abs().max()) == pytest.approx(1.6 * math.sin(0.4 * math.pi), rel=0.03)
    # Along the viewing direction: half of 2% of the distance, since all cameras are in a plane.
    assert float(places[:, 2].abs().max()) == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(("spread", "one"), [(38.0, True), (44.0, False)])
def test_one_direction_is_within_forty_degrees_of_the_mean(spread, one):
    """Two groups at ± spread: the mean of their directions is cos(spread) long, at least 0.75."""
    cameras = []
    for sign in (-1, 1):
        angle = sign * math.radians(spread)
        ahead = torch.tensor([math.sin(angle), 0.0, math.cos(angle)]).double()
        cameras += [camera_at((0.1 * i, 0.0, 0.0), 5 * ahead) for i in range(3)]
    if one:
        assert len(spiral_path(cameras, 10, 3.0)) == 10
    else:
        with pytest.raises(UserError, match="ellipse"):
            spiral_path(cameras, 10, 3.0)


def test_one_camera_and_one_frame_are_enough():
    assert len(ellipse_path(ring(1), 12, 3.0)) == 12
    assert len(spiral_path(ring(1), 12, 3.0)) == 12
    assert len(ellipse_path(ring(9), 1, 3.0)) == 1
