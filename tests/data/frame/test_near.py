"""The near plane of a dataset is relative to its scene."""

import dataclasses

import pytest
import torch

from snowsplat.data.frame.near import near_of
from snowsplat.scene.camera import NEAR, Camera, near_of_overview, near_plane
from snowsplat.trajectory import orbit_path


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
