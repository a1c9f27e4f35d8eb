"""What cameras see of Gaussians: weights, pixels and directions."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.scene.sight import ENTRIES, sight


def gaussians(*places: tuple[float, float, float], opacity: float = 0.5) -> Gaussians:
    """Round Gaussians with σ = 0.1."""
    n = len(places)
    return Gaussians(
        means=torch.tensor(places),
        log_scales=torch.full((n, 3), math.log(0.1)),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), math.log(opacity / (1.0 - opacity))),
        sh_dc=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


def camera(*place: float, size: int = 100) -> Camera:
    """At ``place``, looking at the origin; 100 pixels for a unit at the distance 1."""
    pose = look_at(torch.tensor(place), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return Camera(size, size, 1.0 * size, 1.0 * size, size / 2, size / 2, pose)


def test_pixels_and_directions_are_those_of_the_views():
    scene = gaussians((0.0, 0.0, 0.0), (0.0, 0.0, 9.0))
    found = sight(scene, [camera(0.0, 0.0, -2.0), camera(4.0, 0.0, 0.0)])
    # The first camera, at the distance 2, has 2500 pixels on a unit of area, the second one 625.
    near, far = 2500.0, 625.0
    expected = (near + far) / (near**2 + far**2)
    assert float(found.pixels[0]) == pytest.approx(expected, rel=1e-5)
    expected = [3.0 * far / (near + far), 0.0, 3.0 * near / (near + far), 0.0, 0.0, 0.0]
    assert found.directions[:, 0].tolist() == pytest.approx(expected, abs=1e-5)
    # Only the first camera has the second Gaussian in its image.
    assert float(found.pixels[1]) == pytest.approx(11.0**2 / 100.0**2, rel=1e-5)
    assert found.directions[:, 1].tolist() == pytest.approx([0, 0, 3, 0, 0, 0], abs=1e-5)


def test_weights_are_pixels_that_are_not_hidden():
    scene = gaussians((0.0, 0.0, -0.5), (0.0, 0.0, 0.0), opacity=0.99)
    view = camera(0.0, 0.0, -3.0)
    found = sight(scene, [view])
    assert float(found.weights.sum()) == pytest.approx(float(render(scene, view).alpha.sum()))
    assert float(found.weights[1]) < 0.3 * float(found.weights[0])


@pytest.mark.parametrize("size", [300, 1200])
def test_large_images_are_reduced_but_weights_count_their_pixels(size):
    scene, view = gaussians((0.0, 0.0, 0.0)), camera(0.0, 0.0, -3.0, size=size)
    expected = float(render(scene, view).alpha.sum())
    assert float(sight(scene, [view]).weights[0]) == pytest.approx(expected, rel=0.05)


def test_without_cameras_pixels_follow_the_spacing():
    grid = torch.cartesian_prod(*[torch.arange(6.0)] * 3)
    scene = gaussians(*grid.tolist())
    found, twice = sight(scene, []), sight(gaussians(*(2.0 * grid).tolist()), [])
    torch.testing.assert_close(4.0 * found.pixels, twice.pixels)
    assert float(found.pixels.min()) > 0.0
    assert found.weights.eq(1.0).all()
    for entry, (i, j) in zip(found.directions, ENTRIES, strict=True):
        assert entry.eq(float(i == j)).all()


def test_few_gaussians_and_unseen_ones_have_finite_values():
    for scene in (gaussians((0.0, 0.0, 0.0)), gaussians((0.0, 0.0, -9.0), (9.0, 0.0, 0.0))):
        for cameras in ([], [camera(0.0, 0.0, -3.0)]):
            found = sight(scene, cameras)
            for values in (found.weights, found.pixels, found.directions):
                assert values.isfinite().all()


def test_pixels_of_an_antialiased_scene_have_no_effect():
    scene = gaussians((0.0, 0.0, 0.0))
    scene.antialiased = True
    assert sight(scene, [camera(0.0, 0.0, -3.0)]).pixels.eq(0.0).all()
