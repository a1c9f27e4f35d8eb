"""The initial view of a viewer."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.initial_view import overview, view_of_camera


def test_view_of_a_camera():
    position = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    target = torch.tensor([1.0, -2.0, 8.0], dtype=torch.float64)
    pose = look_at(position, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    view = view_of_camera(Camera(100, 300, 150.0, 150.0, 50.0, 150.0, pose), 2.0)
    assert view.position == pytest.approx((1, -2, 3))
    assert view.target == pytest.approx((1, -2, 5))
    assert view.fov == pytest.approx(90.0)  # of the longer side


def test_a_usual_window_shows_the_complete_photo():
    pose = torch.eye(3, 4, dtype=torch.float64)
    for width, height, whole in ((300, 300, 1.6), (400, 300, 1.6), (480, 300, 1.6), (600, 300, 2)):
        view = view_of_camera(Camera(width, height, 300.0, 300.0, 1.0, 1.0, pose), 2.0)
        assert math.tan(math.radians(view.fov / 2)) == pytest.approx(0.5 * whole)


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
    """The distance at which the shorter side shows ``radius``.

    The field of view is 60° along the longer side, which is 1.6 times as long as the shorter.
    """
    return 1.6 * radius / math.tan(math.radians(30))


@pytest.mark.parametrize(
    ("means", "radius"),
    [
        # Distances 0, 0.1, 0.1, …, 2, 2: the radius of 95% is 1.9.
        (row_along_x(2.0, 41), 1.9),
        # With a background: half of the points are within 1.5, and 2.5 times that is shown.
        (torch.cat([row_along_x(2.0, 41), row_along_x(1000.0, 2).repeat(10, 1)]), 3.75),
    ],
    ids=["object", "background"],
)
def test_overview_contains_the_stated_radius(means: torch.Tensor, radius: float):
    shift = torch.tensor([10.0, 20.0, 30.0])
    hidden = balls(torch.full((100, 3), 77.0), opacity_logit=math.log(0.19 / 0.81))
    seen = balls(means + shift, opacity_logit=math.log(0.21 / 0.79))
    view = overview(Gaussians.cat([seen, hidden]))
    assert view.fov == 60
    assert view.target == pytest.approx((10, 20, 30), abs=1e-4)
    distance = distance_that_shows(radius)
    length = math.hypot(0.35, 1)
    expected = (10, 20 - distance * 0.35 / length, 30 - distance / length)
    assert view.position == pytest.approx(expected, rel=1e-4)


def test_overview_of_a_scene_without_opaque_gaussians_shows_the_others():
    faint = balls(row_along_x(2.0, 41), opacity_logit=-5.0)
    broken = balls(torch.full((50, 3), float("inf")), opacity_logit=-5.0)
    view = overview(Gaussians.cat([faint, broken]))
    assert math.dist(view.position, view.target) == pytest.approx(distance_that_shows(1.9))


def test_overview_without_an_extent():
    """Without Gaussians, the radius is 1. If all are in one place, it is slightly above 0."""
    nothing = overview(balls(torch.zeros(0, 3)))
    assert nothing.target == (0, 0, 0)
    assert math.dist(nothing.position, nothing.target) == pytest.approx(distance_that_shows(1.0))
    one = overview(balls(torch.zeros(3, 3)))
    assert math.dist(one.position, one.target) == pytest.approx(distance_that_shows(1e-6))
