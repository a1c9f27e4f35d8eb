"""The box around a scene, from cameras and from points."""

import dataclasses
import math

import pytest
import torch

from snowsplat.data.frame.bounds import near_of, scene_bounds
from snowsplat.scene.camera import NEAR, Camera, near_of_overview, near_plane
from snowsplat.scene.geometry import look_at
from snowsplat.trajectory import orbit_path

F64 = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def camera(position, target) -> Camera:
    pose = look_at(torch.tensor(position, dtype=F64), torch.tensor(target, dtype=F64), UP)
    return Camera(400, 400, 555.5, 555.5, 200, 200, pose)


def ring(radius, centre, aim):
    """12 cameras in a ring that look at the centre (``aim`` = 1) or outwards (−1)."""
    cameras = []
    for i in range(12):
        angle = i * math.pi / 6
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        position = [centre[0] + x, centre[1] + y, centre[2]]
        cameras.append(camera(position, [position[0] - aim * x, position[1] - aim * y, centre[2]]))
    return cameras


def test_cameras_around_an_object():
    low, high = scene_bounds(ring(4.0, (10.0, 0.0, -3.0), 1.0))
    assert torch.allclose((low + high) / 2, torch.tensor([10.0, 0.0, -3.0]), atol=1e-5)
    half = 0.9 * 4.0 * 200 / 555.5  # Blender's cameras: 1.3, the known size of those scenes
    assert torch.allclose(high - low, torch.full((3,), 2 * half), atol=1e-5)


def test_cameras_that_look_outwards_are_inside_the_box():
    low, high = scene_bounds(ring(1.0, (5.0, 5.0, 0.0), -1.0))
    assert torch.allclose((low + high) / 2, torch.tensor([5.0, 5.0, 0.0]), atol=1e-4)
    assert (high - low).min() > 4


@pytest.mark.parametrize("count", [1, 5])
def test_parallel_cameras_have_the_scene_in_front(count):
    cameras = [camera([i, 0.0, 0.0], [i, 10.0, 0.0]) for i in range(count)]
    low, high = scene_bounds(cameras)
    assert torch.isfinite(low).all()
    assert low[1] > 0
    assert low[0] < (count - 1) / 2 < high[0]


def test_points_determine_the_box_without_outliers():
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    points[0] = 1e6
    low, high = scene_bounds(ring(4.0, (0.0, 0.0, 0.0), 1.0), points)
    assert ((low > 0) & (low < 0.1)).all()
    assert ((high > 0.9) & (high < 1)).all()


def test_no_cameras():
    with pytest.raises(ValueError, match="needs at least one camera"):
        scene_bounds([])


def test_sizes_of_the_cubes_without_a_common_point():
    """The extent is 1.1 times the distance of the outermost camera from the middle."""
    low, high = scene_bounds(ring(1.0, (5.0, 5.0, 0.0), -1.0))
    torch.testing.assert_close(high - low, torch.full((3,), 2 * 5 * 1.1))
    # Parallel cameras: five extents in front of the middle, 90% of the field of view.
    cameras = [camera([x, 0.0, 0.0], [x, 10.0, 0.0]) for x in (0.0, 1.0, 4.0)]
    distance = 5 * 1.1 * (4 - 5 / 3)
    low, high = scene_bounds(cameras)
    torch.testing.assert_close((low + high) / 2, torch.tensor([5 / 3, distance, 0.0]))
    torch.testing.assert_close(high - low, torch.full((3,), 2 * 0.9 * distance * 200 / 555.5))
    alone = scene_bounds(cameras[:1])  # the extent of a single camera is 1.1
    torch.testing.assert_close(alone.mean(0), torch.tensor([0.0, 5.5, 0.0]))


def test_quantiles_need_a_hundred_points():
    points = torch.zeros(100, 3)
    points[:, 0] = torch.arange(100)
    low, high = scene_bounds(ring(4.0, (0.0, 0.0, 0.0), 1.0), points)
    assert (float(low[0]), float(high[0])) == pytest.approx((0.99, 98.01))
    low, high = scene_bounds(ring(4.0, (0.0, 0.0, 0.0), 1.0), points[1:])
    assert float(low[0]) == pytest.approx(-float(high[0]), abs=1e-4)


def cameras(scale=1.0, count=12):
    """Cameras on a line, 4 units in front of the plane z = 0."""
    turn = torch.eye(3, dtype=torch.float64)
    centres = [torch.tensor([i - 6.0, 0.0, -4.0], dtype=torch.float64) for i in range(count)]
    poses = [torch.cat([turn, -scale * centre[:, None]], 1) for centre in centres]
    return [Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose) for pose in poses]


def plane(scale=1.0, depth=0.0):
    across = torch.linspace(-9.0, 9.0, 80)
    x, y = torch.meshgrid(across, across, indexing="ij")
    return scale * torch.stack([x, y, torch.full_like(x, depth)], -1).reshape(-1, 3)


def test_usual_scenes_have_the_near_plane_of_the_paper():
    assert near_of(cameras(), plane()) == NEAR
    assert near_of(cameras()[:7], None) == NEAR


@pytest.mark.parametrize("power", [-13, -1, 4, 13])
@pytest.mark.parametrize("has_points", [True, False])
def test_the_near_plane_is_scaled_with_the_scene(power, has_points):
    scale = 2.0**power
    points = plane(scale) if has_points else None
    unscaled = near_of(cameras(), plane() if has_points else None)
    assert near_of(cameras(scale), points) == scale * unscaled


@pytest.mark.parametrize("scale", [1e-4, 0.7, 1e4])
def test_that_of_an_orbit_is_scaled_by_any_factor(scale):
    weights = torch.ones(6400)
    usual, scaled = (orbit_path(plane(s), weights, 3, 64, 48)[0] for s in (1.0, scale))
    assert scaled.near == pytest.approx(scale * usual.near, rel=1e-5)
    assert near_of_overview(0.0) == near_of_overview(float("nan")) == NEAR


def test_what_is_close_to_the_cameras_is_not_cut_off():
    """A wall 400 units away does not hide that each camera sees something at a depth of 0.4."""
    x, y = torch.meshgrid(torch.linspace(-7, 7, 700), torch.linspace(-0.1, 0.1, 5), indexing="ij")
    close = torch.stack([x, y, torch.full_like(x, -3.6)], -1).reshape(-1, 3)
    near = near_of(cameras(), torch.cat([close, plane(100.0, depth=4.0)]))
    assert 0.4 / 8 < near < 0.4 / 2


def test_a_distance_that_is_no_number_gives_the_near_plane_of_the_paper():
    assert near_plane(0.0) == near_plane(float("inf")) == near_plane(float("nan")) == NEAR


def test_cameras_refuse_a_near_plane_that_is_not_in_front():
    with pytest.raises(ValueError, match="near plane"):
        dataclasses.replace(cameras()[0], near=0.0)
