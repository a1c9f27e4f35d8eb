"""Principal points: the maximum a posteriori estimate, and photos that decide or do not."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.lenses import principal_point
from snowsplat.sfm.colmap.lenses.principal_point import (
    SIGMA,
    combine_with_prior,
    refine_principal_points,
)

WIDTH, HEIGHT, FOCAL = 1000, 800, 900.0
CENTRE = np.array([WIDTH, HEIGHT]) / 2
TRUE = CENTRE + np.array([12.0, -9.0])


def rotation_about(axis, angle):
    return pycolmap.Rotation3d(angle * np.asarray(axis, float))


def photographed(poses, points, noise=0.3, seed=0):
    """A model of photos of ``points`` whose principal point is `TRUE`, with the camera at `CENTRE`.

    ``poses``: cam_from_world of each photo.
    """
    random = np.random.default_rng(seed)
    truth = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    truth.params = [FOCAL, *TRUE, 0.0]
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for number, pose in enumerate(poses, 1):
        seen = np.asarray(truth.img_from_cam(pose * points))
        inside = ((seen >= 0) & (seen < [WIDTH, HEIGHT])).all(1) & ((pose * points)[:, 2] > 0)
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
        measured = seen[inside] + noise * random.standard_normal((inside.sum(), 2))
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in measured])
        model.add_image_with_trivial_frame(image, pose)
        for row, point in enumerate(np.flatnonzero(inside)):
            tracks[point].add_element(number, row)
    for xyz, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    model.update_point_3d_errors()
    return model


def box_of_points(seed=1, count=400):
    return np.random.default_rng(seed).uniform((-2, -2, -2), (2, 2, 2), (count, 3))


def round_walk(count=12):
    """Poses around the origin, each turned about its own axis a bit, so that all is determined."""
    for i in range(count):
        turn = rotation_about((0, 1, 0), 2 * np.pi * i / count)
        roll = rotation_about((0, 0, 1), 0.4 * (-1) ** i)
        yield pycolmap.Rigid3d(roll * turn, [0, 0, 7])


def point_of(model):
    return model.cameras[1].params[1:3]


def test_photos_that_determine_the_principal_point_decide():
    found = refine_principal_points(photographed(list(round_walk()), box_of_points()), 1)
    assert np.abs(point_of(found) - TRUE).max() < 0.5
    assert found.compute_mean_reprojection_error() < 0.5


def test_the_given_model_is_not_changed():
    given = photographed(list(round_walk()), box_of_points())
    refine_principal_points(given, 1)
    assert (point_of(given) == CENTRE).all()


def test_photos_without_a_pose_do_not_matter():
    given = photographed(list(round_walk(13)), box_of_points())
    pycolmap.ObservationManager(given).deregister_frame(given.image(7).frame_id)
    given.update_point_3d_errors()
    found = refine_principal_points(given, 1)
    assert np.abs(point_of(found) - TRUE).max() < 0.5
    assert found.num_reg_frames() == 12
    assert not found.image(7).has_pose


@pytest.mark.parametrize(("photos", "points", "noise"), [(4, 12, 1.0), (5, 15, 3.0)])
def test_photos_that_hardly_determine_it_leave_it_near_the_centre(photos, points, noise):
    model = photographed(list(round_walk())[:photos], box_of_points(count=points), noise)
    found = refine_principal_points(model, 1)
    assert found is not model
    assert np.abs(point_of(found) - CENTRE).max() < SIGMA * WIDTH
    assert found.compute_mean_reprojection_error() < noise


def test_photos_that_say_nothing_leave_the_model_as_it_is():
    """A motion without rotation determines no lens."""
    things = np.random.default_rng(0).uniform((-4, -3, 5), (4, 3, 7), (200, 3))
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(), [x, 0, 0]) for x in (-0.5, 0.0, 0.5)]
    model = photographed(poses, things)
    assert refine_principal_points(model, 1) is model


def test_a_camera_without_principal_point_is_left_alone():
    model = pycolmap.Reconstruction()
    assert refine_principal_points(model, 1) is model


@pytest.mark.parametrize("seed", range(3))
def test_the_combination_has_the_largest_product_of_both_densities(seed):
    random = np.random.default_rng(seed)
    estimate, centre = random.normal(0, 10, 2), random.normal(0, 10, 2)
    root = random.normal(0, 3, (2, 2))
    covariance, sigma = root @ root.T, 4.0

    def cost(p):
        away = p - estimate
        return away @ np.linalg.solve(covariance, away) + ((p - centre) ** 2).sum() / sigma**2

    best = combine_with_prior(estimate, covariance, centre, sigma)
    for step in 1e-3 * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        assert cost(best + step) > cost(best)


def test_a_certain_estimate_and_none_at_all():
    estimate, centre = np.array([3.0, 4.0]), np.array([0.0, 0.0])
    assert np.allclose(combine_with_prior(estimate, 1e-12 * np.eye(2), centre, 1.0), estimate)
    far = combine_with_prior(estimate, 1e12 * np.eye(2), centre, 1.0)
    assert np.allclose(far, centre, atol=1e-9)
    nothing = np.full((2, 2), np.inf)
    assert (combine_with_prior(estimate, nothing, centre, 1.0) == centre).all()


def test_of_many_photos_some_tell_the_covariance(monkeypatch):
    monkeypatch.setattr(principal_point, "_MOST_PHOTOS", 6)
    found = refine_principal_points(photographed(list(round_walk()), box_of_points()), 1)
    assert np.abs(point_of(found) - TRUE).max() < 0.5
