"""The initial view of a viewer."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.initial_view import bounding_sphere, overview, view_of_camera


def test_view_of_a_camera():
    position = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    target = torch.tensor([1.0, -2.0, 8.0], dtype=torch.float64)
    pose = look_at(position, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    view = view_of_camera(Camera(100, 300, 150.0, 150.0, 50.0, 150.0, pose), 2.0)
    assert view.position == pytest.approx((1, -2, 3))
    assert view.target == pytest.approx((1, -2, 5))
    assert view.fov == pytest.approx(90.0)  # of the longer side


@pytest.mark.parametrize("photo", [(300, 300), (600, 300), (300, 500)])
@pytest.mark.parametrize("window", [(1920, 1080), (390, 844), (500, 500)])
def test_a_window_shows_the_complete_photo(photo, window):
    """And one of its sides is that of the photo."""
    (width, height), pose = photo, torch.eye(3, 4, dtype=torch.float64)
    seen = Camera(width, height, 400.0, 300.0, width / 2, height / 2, pose)
    view = view_of_camera(seen, 2.0)
    for shown in (view, view.with_aspect(view.aspect)):
        camera = shown.camera(*window)
        torch.testing.assert_close(camera.cam_from_world, pose)
        # At the edge of the photo, relative to that of the window.
        across = width / 400 / (window[0] / camera.fx)
        down = height / 300 / (window[1] / camera.fy)
        assert max(across, down) == pytest.approx(1)
    wider = view.with_aspect(1.7).camera(*window)
    assert wider.fx <= camera.fx * (1 + 1e-9)
    same_shape = view.with_aspect(1.7).camera(1700, 1000)
    assert max(width / 400 * same_shape.fx / 1700, height / 300 * same_shape.fy / 1000) == (
        pytest.approx(1)
    )


def balls(means: torch.Tensor, opacity_logit: float = 3.0) -> Gaussians:
    n = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    logits = torch.full((n,), opacity_logit)
    return Gaussians(
        means, torch.full((n, 3), -3.0), quats, logits, torch.zeros(n, 1, 3), torch.zeros(n, 0, 3)
    )


def test_overview_shows_the_object_and_not_the_background():
    generator = torch.Generator().manual_seed(0)
    thing = torch.randn(3000, 3, generator=generator) * 0.1 + torch.tensor([5.0, 6.0, 7.0])
    sky = torch.randn(500, 3, generator=generator) * 1000
    haze = balls(torch.randn(9000, 3, generator=generator) * 50, opacity_logit=-5.0)
    broken = balls(torch.full((5, 3), float("nan")))
    scene = Gaussians.cat([balls(thing), balls(sky), haze, broken])
    view = overview(scene)
    assert math.dist(view.target, (5, 6, 7)) < 0.1
    assert 0.3 < math.dist(view.position, view.target) < 3
    assert view.position[2] < 7  # in front of it
    assert view.position[1] < 6  # above it: y points down


@pytest.mark.parametrize("n", [0, 1])
def test_overview_of_no_or_one_gaussian(n):
    view = overview(balls(torch.ones(n, 3)))
    assert all(map(math.isfinite, (*view.position, *view.target)))
    assert view.position != view.target


def row_along_x(last: float, count: int) -> torch.Tensor:
    """``count`` points at equal distances from −last to last."""
    means = torch.zeros(count, 3)
    means[:, 0] = torch.linspace(-last, last, count)
    return means


def distance_that_shows(radius: float) -> float:
    return 2.77 * radius


@pytest.mark.parametrize(
    "far", [torch.zeros(0, 3), row_along_x(1000.0, 2).repeat(10, 1)], ids=["object", "background"]
)
def test_overview_contains_the_object(far: torch.Tensor):
    """It is 2 long, and longer on one side of its median than on the other."""
    shift = torch.tensor([10.0, 20.0, 30.0])
    heavy = row_along_x(0.5, 41) - torch.tensor([0.5, 0.0, 0.0])
    body = torch.cat([heavy, row_along_x(1.0, 101)])
    hidden = balls(torch.full((100, 3), 77.0), opacity_logit=math.log(0.19 / 0.81))
    means = torch.cat([body, far]) + shift
    seen = balls(means, opacity_logit=math.log(0.21 / 0.79))
    scene = Gaussians.cat([seen, hidden])
    middle, radius = bounding_sphere(scene)
    assert middle.tolist() == pytest.approx([10, 20, 30], abs=0.1)
    assert radius == pytest.approx(1, abs=0.1)
    view = overview(scene)
    assert view.target == pytest.approx(middle.tolist())
    distance = distance_that_shows(radius)
    length = math.hypot(0.35, 1)
    x, y, z = view.target
    expected = (x, y - distance * 0.35 / length, z - distance / length)
    assert view.position == pytest.approx(expected, rel=1e-4)
    # A sphere around the middle fits into a square window.
    assert math.sin(math.radians(view.fov / 2)) == pytest.approx(radius / distance)


def test_overview_of_a_scene_without_opaque_gaussians_shows_the_others():
    faint = balls(row_along_x(2.0, 41), opacity_logit=-5.0)
    broken = balls(torch.full((50, 3), float("inf")), opacity_logit=-5.0)
    view = overview(Gaussians.cat([faint, broken]))
    distance = math.dist(view.position, view.target)
    assert distance == pytest.approx(distance_that_shows(2.0), rel=0.03)


def test_overview_without_an_extent():
    """Without Gaussians, the radius is 1. If all are in one place, it is slightly above 0."""
    nothing = overview(balls(torch.zeros(0, 3)))
    assert nothing.target == (0, 0, 0)
    assert math.dist(nothing.position, nothing.target) == pytest.approx(distance_that_shows(1.0))
    one = overview(balls(torch.zeros(3, 3)))
    assert math.dist(one.position, one.target) == pytest.approx(distance_that_shows(1e-6))
