"""The COLMAP database: one camera per group, and reuse only if photos and settings are the same."""

import dataclasses
import sqlite3
from contextlib import closing

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.database import (
    VerifiedPair,
    closing_database,
    copy_without_verification,
    displacements_of,
    feature_counts,
    open_database,
    read_descriptors,
    replace_database,
    set_cameras,
    verified_pairs,
)
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.ingest.photo import Photo


def photo(name, group="phone", focal=None, size=(640, 480)):
    return Photo(name, name, *size, group, focal=focal)


PHOTOS = [photo(f"ünter wegs/{i} b.jpg") for i in range(8)] + [
    photo("x.jpg", "zoom", 900.0, (480, 640)),
    photo("y.jpg", "zoom", 910.0, (480, 640)),
]


@pytest.fixture
def path(tmp_path):
    folder = tmp_path / "mit Lücke"
    folder.mkdir()
    path = folder / "database.db"
    open_database(path, PHOTOS, Lens("auto"), "one")
    return path


def add_features(path, count=5, photo=1, descriptors=True):
    sift = pycolmap.FeatureExtractorType.SIFT
    with closing_database(path) as database:
        database.write_keypoints(photo, np.ones((count, 4), np.float32))
        if descriptors:
            values = np.ones((count, 128), np.uint8)
            database.write_descriptors(photo, pycolmap.FeatureDescriptors(sift, values))


def names(path):
    with closing_database(path) as database:
        return {image.image_id: image.name for image in database.read_all_images()}


def test_photos_of_a_group_share_a_camera(path):
    with closing_database(path) as database:
        cameras = {c.camera_id: c for c in database.read_all_cameras()}
        of_photo = {i.name: cameras[i.camera_id] for i in database.read_all_images()}
        assert database.num_rigs() == 2
        assert database.num_frames() == len(PHOTOS)
    assert len(cameras) == 2
    phone, zoom = of_photo[PHOTOS[0].name], of_photo["x.jpg"]
    assert of_photo[PHOTOS[7].name] is phone
    assert of_photo["y.jpg"] is zoom
    assert (phone.model_name, phone.width, phone.has_prior_focal_length) == ("OPENCV", 640, False)
    # Two photos are not enough for the eight parameters of OPENCV.
    assert (zoom.model_name, zoom.width, zoom.has_prior_focal_length) == (
        "SIMPLE_RADIAL",
        480,
        True,
    )
    assert zoom.mean_focal_length() == 905


def test_photos_change_their_groups(path):
    add_features(path)
    alone = [dataclasses.replace(p, group=f"{p.group} {i}") for i, p in enumerate(PHOTOS)]
    for photos, count in ((alone, len(PHOTOS)), (PHOTOS, 2)):
        set_cameras(path, photos, Lens("auto"))
        with closing_database(path) as database:
            assert database.num_cameras() == database.num_rigs() == count
            used = {i.camera_id: i for i in database.read_all_images()}
            assert set(used) == {c.camera_id for c in database.read_all_cameras()}
            frames = {frame.frame_id: frame for frame in database.read_all_frames()}
            for image in database.read_all_images():
                frame = frames[image.image_id]
                assert frame.rig_id == image.camera_id
                assert image.data_id in frame.data_ids
    assert feature_counts(path, len(PHOTOS))[0] == 5


def test_features_are_reused_for_the_same_settings_only(path):
    add_features(path)
    open_database(path, PHOTOS, Lens("auto"), "one")
    assert feature_counts(path, len(PHOTOS))[0] == 5
    open_database(path, PHOTOS, Lens("auto"), "another")
    assert feature_counts(path, len(PHOTOS)) == [0] * len(PHOTOS)


def test_what_an_interrupted_run_has_half_written(path):
    """A kill between keypoints and descriptors, and one between a camera and its rig."""
    add_features(path)
    add_features(path, photo=2, descriptors=False)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DELETE FROM rigs WHERE rig_id = 2")
    open_database(path, PHOTOS, Lens("auto"), "one")
    assert feature_counts(path, len(PHOTOS))[:2] == [5, 0]
    add_features(path, photo=2)
    with closing_database(path) as database:
        assert database.num_rigs() == 2


def test_another_camera_model_keeps_the_features(path):
    add_features(path)
    open_database(path, PHOTOS, Lens("RADIAL"), "one")
    assert feature_counts(path, len(PHOTOS))[0] == 5
    with closing_database(path) as database:
        assert {c.model_name for c in database.read_all_cameras()} == {"RADIAL"}


@pytest.mark.parametrize("how", ["truncated", "no fingerprint", "text", "empty"])
def test_a_damaged_database_is_replaced(path, how):
    add_features(path, 5000)
    if how == "truncated":
        with open(path, "rb+") as file:
            file.truncate(path.stat().st_size // 2)
    elif how == "no fingerprint":
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("DROP TABLE snowsplat")
    else:
        path.write_bytes(b"" if how == "empty" else b"not a database" * 1000)
    open_database(path, PHOTOS, Lens("auto"), "one")
    assert len(names(path)) == len(PHOTOS)
    assert feature_counts(path, len(PHOTOS)) == [0] * len(PHOTOS)


def test_one_database_replaces_another(path):
    strong = path.with_name("strong.db")
    open_database(strong, PHOTOS, Lens("auto"), "strong")
    add_features(strong)
    replace_database(path, by=strong)
    assert not strong.exists()
    assert feature_counts(path, len(PHOTOS))[0] == 5


def test_verified_pairs_have_their_kind(path):
    matches = np.stack([np.arange(20), np.arange(20)], 1).astype(np.uint32)
    with closing_database(path) as database:
        for other, config in ((2, "CALIBRATED"), (3, "PANORAMIC")):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = getattr(pycolmap.TwoViewGeometryConfiguration, config)
            geometry.inlier_matches = matches
            database.write_two_view_geometry(1, other, geometry)
    pairs = {(p.first, p.second): (p.matches, p.flat) for p in verified_pairs(path)}
    assert pairs == {(1, 2): (20, False), (1, 3): (20, True)}


def test_a_copy_without_verification_leaves_the_database_as_it_is(path, tmp_path):
    """An interrupted run begins with the verification of the first attempt again."""
    rows = np.stack([np.arange(4), np.arange(4)], 1).astype(np.uint32)
    found = pycolmap.TwoViewGeometry()
    found.inlier_matches = rows
    with closing_database(path) as database:
        database.write_matches(1, 2, rows)
        database.write_two_view_geometry(1, 2, found)
    other = tmp_path / "other.db"
    copy_without_verification(path, other)
    assert len(verified_pairs(path)) == 1
    assert verified_pairs(other) == []
    with closing_database(other) as database:
        assert database.exists_matches(1, 2)
        assert database.num_images() == len(PHOTOS)


def test_descriptors_of_the_largest_features_are_read(path):
    random = np.random.default_rng(0)
    scale = random.permutation(30) + 1.0
    keypoints = np.zeros((30, 6), np.float32)
    keypoints[:, 0], keypoints[:, 2], keypoints[:, 5] = scale, scale, scale
    with closing_database(path) as database:
        for image_id, count in ((1, 30), (2, 8)):
            database.write_keypoints(image_id, keypoints[:count])
            data = np.repeat(scale[:count, None], 128, 1).astype(np.uint8)
            sift = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(image_id, pycolmap.FeatureDescriptors(sift, data))
    assert feature_counts(path, len(PHOTOS))[:2] == [30, 8]
    assert np.array_equal(read_descriptors(path, 0, 3)[:, 0], [30, 29, 28])


def test_a_photo_without_features_has_no_descriptors(path):
    assert read_descriptors(path, 3, 100).shape == (0, 128)


@pytest.mark.parametrize(("moving", "expected"), [(0, 0.5), (10, 0.5), (40, 80.0), (100, 80.0)])
def test_matches_of_a_logo_do_not_hide_the_displacement(path, moving, expected):
    """``moving`` of 100 matches move by 80 pixels; the others are fixed to the frame."""
    first = np.random.default_rng(0).uniform(100, 400, (100, 2)).astype(np.float32)
    second = first + np.array([0.5, 0])
    second[:moving, 0] += 79.5
    indices = np.arange(100, dtype=np.uint32)
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.stack([indices, indices], axis=1)
    with closing_database(path) as database:
        database.write_keypoints(1, first)
        database.write_keypoints(2, second.astype(np.float32))
        database.write_two_view_geometry(1, 2, geometry)
    pair = VerifiedPair(1, 2, 100)
    assert displacements_of(path, [pair], still=6.4) == [pytest.approx(expected, abs=1e-3)]
