"""Photos whose positions the points do not determine: groups that may have any size."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.checks.repair import repair
from snowsplat.sfm.colmap.checks.undetermined import (
    _covariance,
    _normal_matrix,
    undetermined_photos,
)

FOCAL, PHOTOS = 800.0, 12
ONE, OTHER = range(1, 8), range(7, 13)  # photo 7 is in both groups


def model_of(groups, error=0.5, camera_model="SIMPLE_PINHOLE", points=40):
    """Cameras on an arc of radius 3 around points near the origin; each of ``groups`` has points
    that its photos see."""
    random = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, FOCAL, 800, 600)
    model.add_camera_with_trivial_rig(camera)
    counts = np.zeros(PHOTOS + 1, int)
    for number in range(1, PHOTOS + 1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.15 * number, 0.0]), [0.0, 0.0, 3.0])
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
        image = model.image(number)
        image.points2D = [pycolmap.Point2D([400.0, 300.0]) for _ in range(points * len(groups))]
    for group in groups:
        for xyz in random.uniform(-0.7, 0.7, (points, 3)):
            track = pycolmap.Track()
            for number in group:
                track.add_element(number, int(counts[number]))
                counts[number] += 1
            model.points3D[model.add_point3D(xyz, track)].error = error
    return model


@pytest.mark.parametrize("camera_model", ["SIMPLE_PINHOLE", "OPENCV_FISHEYE", "EQUIRECTANGULAR"])
@pytest.mark.parametrize(
    ("groups", "loose"),
    [
        ([range(1, 13)], set()),
        ([range(i, i + 3) for i in range(1, 11)], set()),  # a long chain
        ([ONE, OTHER], {8, 9, 10, 11, 12}),  # of any size about photo 7
        ([ONE, OTHER, (6, 8)], set()),  # a third direction in the triangle of 6, 7 and 8
        ([range(1, 6), range(6, 13)], {1, 2, 3, 4, 5}),  # no common point
    ],
    ids=["together", "chain", "one photo", "triangle", "apart"],
)
def test_a_group_that_may_have_any_size_is_found(groups, loose, camera_model):
    model = model_of(groups, error=0.1, camera_model=camera_model)
    model.transform(pycolmap.Sim3d(40, pycolmap.Rotation3d([0.3, 1.0, 0.2]), [100, -20, 50]))
    found = undetermined_photos(model)
    assert set(found) == loose
    assert all(error > 1 for error in found.values())


def test_points_without_observations_tell_nothing():
    model = model_of([], points=0)
    model.add_point3D([0.0, 0.0, 0.0], pycolmap.Track())
    assert undetermined_photos(model) == {}


def test_errors_are_those_of_bundle_adjustment_with_known_rotations():
    """By the normal matrix of all observations of three photos, with the points. The first camera
    and the distance of the second one are fixed."""
    model = model_of([(1, 2, 3)], points=20)
    ids = [1, 2, 3]
    centres = np.array([model.image(i).projection_center() for i in ids])
    xyz = np.array([p.xyz for p in model.points3D.values()])
    sigma = 0.5 / np.sqrt(2)
    rows = []
    for i in range(3):
        for j in range(len(xyz)):
            away = xyz[j] - centres[i]
            depth = np.linalg.norm(away)
            ray = away / depth
            slope = FOCAL / (sigma * depth) * (np.eye(3) - np.outer(ray, ray))
            row = np.zeros((3, 9 + 3 * len(xyz)))
            row[:, 3 * i : 3 * i + 3], row[:, 9 + 3 * j : 12 + 3 * j] = -slope, slope
            rows.append(row)
    jacobian = np.concatenate(rows)
    away = centres[1] - centres[0]
    across = np.linalg.svd(away[None])[2][1:].T  # of the second camera, at a fixed distance
    free = np.zeros((jacobian.shape[1], jacobian.shape[1] - 4))
    free[3:6, :2], free[6:, 2:] = across, np.eye(jacobian.shape[1] - 6)
    covariance = free @ np.linalg.inv((jacobian @ free).T @ (jacobian @ free)) @ free.T
    expected = np.sqrt(np.trace(covariance[6:9, 6:9]))

    frame = np.zeros((3, 3, 4))
    frame[:, :, :3], frame[:, :, 3] = np.eye(3), centres - centres[0]
    normal = _normal_matrix(centres, np.full(3, FOCAL / sigma), xyz, [[0, 1, 2]] * len(xyz))
    # The frame in which the first camera is fixed, and the distance of the second one.
    flat, fixed = frame.reshape(9, 4), np.zeros((4, 9))
    fixed[:3, :3], fixed[3, 3:6] = np.eye(3), away
    change = np.eye(9) - flat @ np.linalg.inv(fixed @ flat) @ fixed
    moved = change @ _covariance(normal, frame).reshape(9, 9) @ change.T
    assert np.sqrt(np.trace(moved[6:9, 6:9])) == pytest.approx(expected, rel=1e-4)


class _Mapping:
    database = None

    def without(self, model, photos):
        for photo in photos:
            model.deregister_frame(model.image(photo).frame_id)
        return model


def test_such_photos_are_left_out_with_a_reason(monkeypatch):
    monkeypatch.setattr("snowsplat.sfm.colmap.checks.repair.check_pairs", lambda *_: [])
    repaired = repair(model_of([ONE, OTHER]), _Mapping(), 4.0)
    assert sorted(repaired.model.reg_image_ids()) == list(ONE)
    assert sorted(repaired.excluded) == ["10.jpg", "11.jpg", "12.jpg", "8.jpg", "9.jpg"]
    assert "its position is not determined" in str(repaired.excluded["8.jpg"])
    assert repaired.description == "5 left out, as their positions are not determined"
