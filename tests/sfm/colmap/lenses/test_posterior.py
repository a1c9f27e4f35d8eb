"""Lenses: the maximum a posteriori estimate, and photos that decide or do not."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.lenses import posterior
from snowsplat.sfm.colmap.lenses.posterior import combine_with_prior, estimate_lenses
from snowsplat.sfm.colmap.lenses.prior import Term, log_prior, parameters, terms

WIDTH, HEIGHT, FOCAL = 1000, 800, 900.0
CENTRE = np.array([WIDTH, HEIGHT]) / 2
TRUE = CENTRE + np.array([12.0, -9.0])


def rotation_about(axis, angle):
    return pycolmap.Rotation3d(angle * np.asarray(axis, float))


def photographed(poses, points, noise=0.3, seed=0, true=TRUE):
    """A model of photos of ``points``, with a camera whose principal point is at `CENTRE`.

    ``poses``: cam_from_world of each photo; ``true``: the right principal point.
    """
    random = np.random.default_rng(seed)
    truth = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    truth.params = [FOCAL, *true, 0.0]
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


@pytest.mark.parametrize("true", [TRUE, CENTRE + np.array([110.0, 40.0])], ids=["", "cropped"])
def test_photos_that_determine_the_principal_point_decide(true):
    given = photographed(list(round_walk()), box_of_points(), true=true)
    found = estimate_lenses(given, {}, False, 1)
    assert np.abs(point_of(found) - true).max() < 1.5
    assert found.compute_mean_reprojection_error() < 0.5
    assert (point_of(given) == CENTRE).all()


def test_photos_without_a_pose_do_not_matter():
    given = photographed(list(round_walk(13)), box_of_points())
    pycolmap.ObservationManager(given).deregister_frame(given.image(7).frame_id)
    given.update_point_3d_errors()
    found = estimate_lenses(given, {}, False, 1)
    assert np.abs(point_of(found) - TRUE).max() < 1.0
    assert found.num_reg_frames() == 12
    assert not found.image(7).has_pose


@pytest.mark.parametrize(("photos", "points", "noise"), [(4, 12, 1.0), (5, 15, 3.0)])
def test_photos_that_hardly_determine_it_leave_it_near_the_centre(photos, points, noise):
    model = photographed(list(round_walk())[:photos], box_of_points(count=points), noise)
    found = estimate_lenses(model, {}, False, 1)
    assert found is not model
    assert np.abs(point_of(found) - CENTRE).max() < 0.01 * WIDTH
    assert found.compute_mean_reprojection_error() < noise


def test_photos_that_say_nothing_leave_the_model_as_it_is():
    """A motion without rotation determines no lens."""
    things = np.random.default_rng(0).uniform((-4, -3, 5), (4, 3, 7), (200, 3))
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(), [x, 0, 0]) for x in (-0.5, 0.0, 0.5)]
    model = photographed(poses, things)
    assert estimate_lenses(model, {}, False, 1) is model


@pytest.mark.parametrize(("least", "same"), [(12, False), (13, True)])
def test_models_with_few_photos_of_a_camera_are_left_alone(monkeypatch, least, same):
    monkeypatch.setattr(posterior, "_PHOTOS_OF_CAMERA", least)
    model = photographed(list(round_walk()), box_of_points())
    assert (estimate_lenses(model, {}, False, 1) is model) == same
    assert estimate_lenses(pycolmap.Reconstruction(), {}, False, 1).num_reg_images() == 0


@pytest.mark.parametrize("seed", range(3))
def test_the_combination_has_the_largest_product_of_both_densities(seed):
    random = np.random.default_rng(seed)
    estimate, root = random.normal(0, 10, 3), random.normal(0, 3, (3, 3))
    covariance = root @ root.T
    # Of one direction, nothing is known.
    known = [Term(random.normal(0, 1, 3), random.normal(0, 10), 4.0, 4.0) for _ in range(2)]

    def cost(p):
        away = p - estimate
        prior = sum(((term.factors @ p - term.mean) / term.usual) ** 2 for term in known)
        return away @ np.linalg.solve(covariance, away) + prior

    best = combine_with_prior(estimate, covariance, known)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert cost(best + step) > cost(best)


@pytest.mark.parametrize(("error", "expected"), [(0.1, 30.0), (20.0, 0.0)])
def test_what_the_photos_clearly_contradict_has_no_effect(error, expected):
    """A value of 30, where 1 is usual and 100 is not impossible."""
    known = [Term(np.ones(1), 0.0, 1.0, 100.0)]
    found = combine_with_prior(np.full(1, 30.0), np.full((1, 1), error**2), known)
    assert found[0] == pytest.approx(expected, abs=0.1)


def opencv(focal=FOCAL, **changes):
    """A camera of the model OPENCV, where ``changes`` are parameters by name."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    params = dict(zip(names, [focal, focal, *CENTRE, 0, 0, 0, 0], strict=True)) | changes
    made = pycolmap.Camera.create_from_model_name(1, "OPENCV", focal, WIDTH, HEIGHT)
    made.params = list(params.values())
    return made


@pytest.mark.parametrize(
    ("changes", "deviations"),
    [
        ({"cx": CENTRE[0] + 10}, 1.0),  # 1% of the longer side
        ({"fx": FOCAL * 1.0005}, 1.0),
        # At the corner, ρ² is 0.506 and ρ⁴ 0.256.
        ({"k1": 0.1 / 0.5062}, 1.0),
        ({"k2": -0.25}, 0.25 * 0.2562 / 0.03),
        ({"p1": 0.0005 / 0.7115}, 1.0),
    ],
    ids=["centre", "square", "k1", "k2", "p1"],
)
def test_the_prior_of_each_parameter(changes, deviations):
    cost = log_prior(opencv(), None) - log_prior(opencv(**changes), None)
    assert cost == pytest.approx(deviations**2 / 2, rel=0.03, abs=1e-3)


@pytest.mark.parametrize(("exif", "wrong"), [(FOCAL, False), (1.1 * FOCAL, False), (600.0, True)])
def test_exif_is_believed_unless_the_photos_contradict_it(exif, wrong):
    sure, unsure = (np.diag(np.full(8, sigma**2)) for sigma in (0.001, 1.0))
    term = next(terms(opencv(), exif))
    assert term.deviation(parameters(opencv()), sure) == (0.5 if wrong else 0.05)
    assert term.deviation(parameters(opencv()), unsure) == 0.05


def test_an_absurd_focal_length_becomes_that_of_exif():
    """20 times the width, and hardly determined: one less than zero would be a linear estimate."""
    camera = opencv(20 * WIDTH)
    found = combine_with_prior(parameters(camera), 10.0 * np.eye(8), terms(camera, FOCAL))
    assert np.exp(found[:2]) == pytest.approx([FOCAL, FOCAL], rel=0.01)


def test_the_coefficients_of_a_fisheye_lens_remain_small():
    """θ is at most 0.7 in these photos, which do not determine k₃ and k₄."""
    model = photographed(list(round_walk()), box_of_points())
    model.cameras[1].model = pycolmap.CameraModelId.OPENCV_FISHEYE
    model.cameras[1].params = [FOCAL, FOCAL, *CENTRE, 1 / 3, 0, 0, 0]
    model.update_point_3d_errors()
    found = estimate_lenses(model, {}, False, 1)
    assert np.abs(found.cameras[1].params[6:]).max() < 0.5
    assert found.compute_mean_reprojection_error() < 0.5


def test_a_distortion_that_no_lens_has_needs_evidence():
    """Photos of a plane from nearly one direction hardly determine the distortion."""
    things = np.random.default_rng(0).uniform((-1.5, -1.2, 0), (1.5, 1.2, 0.05), (300, 3))
    poses = [pycolmap.Rigid3d(rotation_about((0, 1, 0), 0.06 * i), [0, 0, 4]) for i in range(-3, 4)]
    model = photographed(poses, things, noise=1.0)
    wrong = opencv(k1=0.2, k2=-0.5)
    model.cameras[1].model, model.cameras[1].params = wrong.model, list(wrong.params)
    model.update_point_3d_errors()
    found = estimate_lenses(model, {}, False, 1)
    k1, k2, p1, p2 = found.cameras[1].params[4:]
    assert abs(k1) < 0.1
    assert abs(k2) < 0.06
    assert max(abs(p1), abs(p2)) < 0.0015
    assert found.compute_mean_reprojection_error() < 1.5


def test_of_many_photos_some_tell_the_covariance(monkeypatch):
    monkeypatch.setattr(posterior, "_MOST_PHOTOS", 6)
    found = estimate_lenses(photographed(list(round_walk()), box_of_points()), {}, False, 1)
    assert np.abs(point_of(found) - TRUE).max() < 1.0


@pytest.mark.parametrize(("noise", "kept"), [(0.3, False), (20.0, True)])
def test_a_focal_length_that_is_held_is_kept_if_the_photos_tell_less(noise, kept):
    model = photographed(list(round_walk()), box_of_points(), noise)
    held = 1.03 * FOCAL
    model.cameras[1].params = [held, *CENTRE, 0.0]
    model.update_point_3d_errors()
    found = estimate_lenses(model, {1: held}, True, 1).cameras[1].mean_focal_length()
    assert (found == held) == kept
    assert kept or found == pytest.approx(FOCAL, rel=0.01)
