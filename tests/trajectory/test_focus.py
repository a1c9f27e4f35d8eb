"""Viewing distance, focus, and cameras with other image sizes."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.trajectory.focus import (
    DEFAULT_UP,
    focus_of,
    resized,
    typical,
    up_of,
    viewing_distance,
)

from .rigs import FOCUS, UP, camera_at, ring, wall


def test_viewing_distance_counts_visible_points():
    cameras = ring(20, 4.0, 4.0)
    random = torch.Generator().manual_seed(0)
    thing = FOCUS.float() + 0.1 * torch.randn(500, 3, generator=random)
    behind = torch.tensor([[0.0, -1000.0, 0.0]]).expand(400, 3)
    expected = math.hypot(4.0, 1.0)
    assert viewing_distance(cameras, torch.cat([thing, behind])) == pytest.approx(expected, abs=0.1)
    assert viewing_distance(cameras, behind) == pytest.approx(1000, rel=0.01)  # none is visible
    assert viewing_distance(cameras, torch.zeros(0, 3)) == 1.0


def test_focus_of_parallel_and_outward_cameras():
    torch.testing.assert_close(
        focus_of(wall(), 5.0), torch.tensor([0.5, 0.225, 5.0], dtype=torch.float64)
    )
    outward = [
        camera_at(
            (math.cos(t), 0.0, math.sin(t)),
            torch.tensor([9 * math.cos(t), 0, 9 * math.sin(t)]).double(),
        )
        for t in torch.arange(12).mul(math.pi / 6).tolist()
    ]
    assert float(focus_of(outward, 5.0).norm()) < 1e-6


def test_resized_cameras_have_square_pixels_and_the_same_area_of_view():
    camera = ring(1)[0]
    same = resized(camera, 128, 96)
    assert (same.fx, same.fy, same.cx, same.cy) == (120.0, 120.0, 64.0, 48.0)
    wide = resized(camera, 160, 90)
    assert wide.fx == wide.fy
    field, before = 160 * 90 / wide.fx**2, 64 * 48 / 60.0**2
    assert field == pytest.approx(before)
    torch.testing.assert_close(wide.cam_from_world, camera.cam_from_world)


def ahead() -> Camera:
    """A camera at the origin that looks along z.

    It sees x / z from −32/60 to 32/60 and y / z from −24/60 to 24/60.
    """
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, torch.eye(3, 4, dtype=torch.float64))


def test_only_points_within_the_image_are_seen():
    inside = torch.tensor([[0.0, 0.0, 0.5]])
    left, above = torch.tensor([[-6.0, 0.0, 10.0]]), torch.tensor([[0.0, -4.5, 10.0]])
    behind = torch.tensor([[0.0, 0.0, -10.0]])
    for outside in (left, -left * torch.tensor([1, 1, -1]), above, behind):
        points = torch.cat([inside, outside.repeat(5, 1)])
        assert viewing_distance([ahead()], points) == 0.5


def test_viewing_distance_is_the_median_over_cameras_of_medians():
    points = torch.tensor([[0.0, 0, 2], [0, 0, 3], [0, 0, 7]])
    at = [camera_at((0.0, 0.0, -z), torch.tensor([0.0, 0, 9]).double()) for z in (0.0, 10.0, 1.0)]
    assert viewing_distance(at, points) == pytest.approx(4.0)  # of 3, 4 and 13
    three = [camera_at((0.0, 0.0, -z), torch.tensor([0.0, 0, 9]).double()) for z in (2, 4, 6, 8, 1)]
    assert viewing_distance(three, points) == pytest.approx(7.0)  # of 4, 5, 7, 9 and 11
    assert viewing_distance([ahead()], torch.zeros(1, 3)) == 1.0  # the point is at the camera


def test_the_typical_camera_has_the_median_field_of_view():
    pose = torch.eye(3, 4, dtype=torch.float64)
    cameras = [Camera(w, 9, f, f, 1.0, 1.0, pose) for w, f in ((10, 50.0), (90, 90.0), (10, 20.0))]
    assert typical(cameras) is cameras[2]  # ratios 5, 1 and 2


@pytest.mark.parametrize(("degrees", "depth"), [(7.0, 10.0), (9.0, 4.0)])
def test_axes_within_eight_degrees_of_their_mean_are_parallel(degrees, depth):
    """Both cameras look at (0, 0, 4); the viewing distance is 10."""
    x = 4 * math.tan(math.radians(degrees))
    target = torch.tensor([0.0, 0.0, 4.0]).double()
    focus = focus_of([camera_at((-x, 0.0, 0.0), target), camera_at((x, 0.0, 0.0), target)], 10.0)
    torch.testing.assert_close(focus, torch.tensor([0.0, 0.0, depth]).double())


def test_a_camera_that_looks_elsewhere_hardly_moves_the_focus():
    """It moves by less than 1% of the distance, at any scale of the scene."""
    focus = torch.tensor([10.0, 20.0, 30.0]).double()
    around = [(4.0, 0, 0), (0.0, 0, 4), (-4.0, 0, 0), (3.0, -2, 0), (0.0, -2, 3), (0.0, 1, -4)]
    targets = focus.repeat(6, 1)
    targets[5] += torch.tensor([3.0, 1.0, 0.0])
    places = torch.tensor(around).double() + focus

    def moved(scale: float) -> torch.Tensor:
        pairs = zip(scale * places, scale * targets, strict=True)
        cameras = [camera_at(place.tolist(), target) for place, target in pairs]
        return focus_of(cameras, 4.0 * scale) / scale - focus

    assert float(moved(1.0).norm()) < 0.01 * 4.0
    torch.testing.assert_close(moved(10.0), moved(1.0))


@pytest.mark.parametrize(("share", "ahead"), [(0.103, True), (0.097, False)])
def test_a_focus_is_at_least_a_tenth_of_the_distance_ahead(share, ahead):
    target = torch.tensor([0.0, 0.0, 1.0]).double()
    distance = math.sqrt(2) / share
    focus = focus_of([camera_at((x, 0.0, 0.0), target) for x in (-1.0, 1.0)], distance)
    expected = target if ahead else distance * target
    torch.testing.assert_close(focus, expected)


def test_axes_that_intersect_behind_the_cameras():
    cameras = [
        camera_at((x, 0.0, 0.0), torch.tensor([2.0 * x, 0.0, 2.0]).double()) for x in (-1.0, 1.0)
    ]
    expected = torch.tensor([0.0, 0.0, 10.0]).double()
    torch.testing.assert_close(focus_of(cameras, 10.0), expected)


@pytest.mark.parametrize(("length", "depth"), [(0.097, 0.0), (0.103, 10.0)])
def test_focus_of_cameras_that_look_away_from_each_other(length, depth):
    """It is their mean centre unless the mean of their directions is at least 0.1 long."""
    across = math.sqrt(1 - length**2)
    targets = [torch.tensor([x * (1 + 5 * across), 0.0, 5 * length]).double() for x in (-1, 1)]
    cameras = [camera_at((x, 0.0, 0.0), target) for x, target in zip((-1, 1), targets, strict=True)]
    expected = torch.tensor([0.0, 0.0, depth]).double()
    torch.testing.assert_close(focus_of(cameras, 10.0), expected)


def test_up_is_the_default_if_cameras_are_level_and_upright():
    x, y, z = FOCUS.tolist()
    for height in (-1.0, 0.5):  # the cameras look down, or up
        cameras = [camera_at((x + math.cos(t), y + height, z + math.sin(t))) for t in range(7)]
        assert torch.equal(up_of(cameras), DEFAULT_UP)
    inverted = [camera_at((x + math.cos(t), y, z + math.sin(t)), up=-UP) for t in range(7)]
    torch.testing.assert_close(up_of(inverted), -DEFAULT_UP)


@pytest.mark.parametrize(("degrees", "level"), [(4.0, True), (8.0, False)])
def test_a_common_roll_of_a_few_degrees_is_kept(degrees, level):
    roll = math.radians(degrees)
    tilted = torch.tensor([math.sin(roll), -math.cos(roll), 0.0]).double()
    cameras = [
        camera_at((0.1 * i, 0.0, 0.0), torch.tensor([0.1 * i, 0.0, 5.0]).double(), tilted)
        for i in range(5)
    ]
    assert torch.equal(up_of(cameras), DEFAULT_UP) == level
    if not level:
        torch.testing.assert_close(up_of(cameras), tilted)
