"""The features of a point are moved to the same place of the scene in all photos."""

import numpy as np
import pycolmap
import pytest
from tests.sfm.colmap.scenes import FOCAL, HEIGHT, WIDTH, arc, photograph, wall, write

from snowsplat.sfm.colmap.database import closing_database, open_database
from snowsplat.sfm.colmap.features import alignment as feature_alignment
from snowsplat.sfm.colmap.features.alignment import align_features
from snowsplat.sfm.colmap.lenses.lens import Lens

CAMERAS = arc(6)
DEPTH = 6.0  # of the wall
NOISE = 0.5  # of the positions, in pixels
FALSE = 7  # the index of the point whose last observation shows another place


def project(pose, points):
    """Pixels (N, 2) of points (N, 3)."""
    seen = points @ pose[:, :3].T + pose[:, 3]
    return FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]


def on_the_wall(pose, pixels):
    """The places (N, 2) on the wall that pixels (N, 2) show, in pixels of the first photo."""
    rays = np.c_[(pixels - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones(len(pixels))] @ pose[:, :3]
    centre = -pose[:, :3].T @ pose[:, 3]
    return project(CAMERAS[0], centre + rays * ((DEPTH - centre[2]) / rays[:, 2])[:, None])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A function that returns a model with inaccurate observations; its folder; these positions."""
    folder = tmp_path_factory.mktemp("wall")
    random = np.random.default_rng(0)
    photos = write(folder, [photograph(wall(), pose, i) for i, pose in enumerate(CAMERAS)])
    points = np.c_[random.uniform(-1.4, 1.4, (60, 1)), random.uniform(-1, 1, (60, 1)),
                   np.full(60, DEPTH)]  # fmt: skip
    observed = np.stack([project(pose, points) for pose in CAMERAS])  # (photos, points, 2)
    observed += random.normal(0, NOISE, observed.shape)
    observed[-1, FALSE] = observed[-1, FALSE + 1] + [9, 9]
    database = folder / "database.db"
    open_database(database, photos, Lens("SIMPLE_PINHOLE"), "")
    angle = random.uniform(0, 6, len(points))  # the same in all photos, as the camera is upright
    scale = random.uniform(0.9, 4, len(points))
    frame = scale * np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)])
    with closing_database(database) as target:
        for i, positions in enumerate(observed):
            target.write_keypoints(i + 1, np.c_[positions, frame.T].astype(np.float32))

    def make():
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, WIDTH, HEIGHT)
        model.add_camera_with_trivial_rig(camera)
        for i, pose in enumerate(CAMERAS):
            image = pycolmap.Image(photos[i].name, observed[i], 1, i + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for k, xyz in enumerate(points):
            track = pycolmap.Track()
            for i in range(len(CAMERAS)):
                track.add_element(i + 1, k)
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
        return model

    return make, folder, observed


def positions_in(model):
    """(photos, points, 2) the observations."""
    return np.stack([[p.xy for p in model.image(i + 1).points2D] for i in range(len(CAMERAS))])


def spread(positions):
    """(points,) how far the observations of a point are from their median, on the wall."""
    places = np.stack([on_the_wall(*both) for both in zip(CAMERAS, positions, strict=True)])
    true = np.delete(places, FALSE, 1)
    return np.linalg.norm(true - np.median(true, 0), axis=2).mean(0)


def test_observations_of_a_point_show_the_same_place(scene):
    make, folder, observed = scene
    model = make()
    align_features(model, folder / "database.db", folder / "input", 1000, threads=2)
    positions = positions_in(model)
    before, after = spread(observed), spread(positions)
    assert np.median(before) > 0.8 * NOISE
    assert np.median(after) < 0.15 * np.median(before)
    assert np.mean(after < 0.1) > 0.9  # pixels
    # The template of each point is not moved, and a false observation is not either.
    moved = np.linalg.norm(positions - observed, axis=2)
    assert (moved.min(0) < 1e-4).all()
    assert moved[-1, FALSE] < 1e-4
    assert model.num_points3D() == observed.shape[1]


def test_blocks_do_not_change_the_result(scene, monkeypatch):
    make, folder, _ = scene
    results = []
    for block in (feature_alignment._BLOCK, 20):
        monkeypatch.setattr(feature_alignment, "_BLOCK", block)
        model = make()
        align_features(model, folder / "database.db", folder / "input", 1000, threads=1)
        results.append(positions_in(model))
    np.testing.assert_array_equal(*results)


def test_photos_may_be_larger_than_the_photos_with_features(scene):
    """Positions are in pixels of the photo; the patches are from the resized one."""
    make, folder, observed = scene
    model = make()
    align_features(model, folder / "database.db", folder / "input", WIDTH * 3 // 4, threads=1)
    assert np.median(spread(positions_in(model))) < 0.25 * np.median(spread(observed))


def test_a_model_without_points(scene):
    make, folder, observed = scene
    model = make()
    for point in list(model.points3D):
        model.delete_point3D(point)
    align_features(model, folder / "database.db", folder / "input", 1000, threads=1)
    np.testing.assert_allclose(positions_in(model), observed)
