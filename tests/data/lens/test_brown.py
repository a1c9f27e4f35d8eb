"""Lenses with r⁸ and skew: their projection, undistortion, and the nearest model of COLMAP."""

import numpy as np
import pytest

from snowsplat.data.lens.models import as_colmap, lens_of
from snowsplat.data.lens.views import pinhole_view

INTRINSICS = 900.0, 905.0, 655.0, 470.0


def lens(k4=0.0, skew=0.0):
    params = (*INTRINSICS, 0.1, -0.05, 0.03, k4, 0.002, -0.001, skew)
    return lens_of("BROWN", 1280, 960, params)


def test_the_skew_moves_points_to_the_right():
    ray = np.array([[0.1, 0.2, 1.0]])
    straight, skewed = lens().project(ray), lens(skew=0.01).project(ray)
    assert skewed[0, 1] == straight[0, 1]
    expected = 0.01 * 900 * (straight[0, 1] - 470) / 905
    assert skewed[0, 0] - straight[0, 0] == pytest.approx(expected)


def test_the_directions_of_pixels_are_found():
    pixels = np.random.default_rng(0).uniform(0, (1280, 960), (50, 2))
    found = lens(-0.04, 0.01).unproject(pixels)
    again = lens(-0.04, 0.01).project(np.column_stack([found, np.ones(50)]))
    assert np.abs(again - pixels).max() < 1e-6


def test_a_photo_is_undistorted():
    made = pinhole_view(lens(-0.04, 0.01))
    assert not made.is_photo
    ((_, positions),) = made.positions(made.width, made.height)
    nodes = positions.nodes
    middle = nodes[nodes.shape[0] // 2, nodes.shape[1] // 2]
    assert np.isfinite(nodes).all()
    assert np.abs(middle - (655, 470)).max() < 30


@pytest.mark.parametrize("k4", [0.0, 0.02, -0.04])
def test_r8_is_nearly_a_model_of_colmap(k4):
    made, error = as_colmap(lens(k4))
    assert made.model == "FULL_OPENCV"
    assert error < 0.02
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 20), np.linspace(-0.45, 0.45, 20))
    rays = np.stack([x, y, np.ones_like(x)], -1)
    assert np.abs(made.project(rays) - lens(k4).project(rays)).max() < 0.05


def test_the_error_without_the_skew_is_told():
    assert as_colmap(lens(skew=0.01))[1] == pytest.approx(0.01 * 900 * 490 / 905, rel=0.1)
    pinhole = lens_of("PINHOLE", 1280, 960, INTRINSICS)
    assert as_colmap(pinhole) == (pinhole, 0.0)
