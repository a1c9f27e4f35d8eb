"""Photos of several zooms without EXIF: each zoom gets a camera of its own, and only then."""

import dataclasses
import re

import numpy as np
import pycolmap
import pytest

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.attempt import Matched
from snowsplat.sfm.colmap.checks.diagnosis import gather_evidence
from snowsplat.sfm.colmap.checks.matches import read_matches
from snowsplat.sfm.colmap.checks.score import score_of
from snowsplat.sfm.colmap.database import set_cameras
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses.camera_groups import (
    describe,
    focals_of,
    group_by_zoom,
    own_focals,
    separate,
)
from snowsplat.sfm.colmap.lenses.lens import Lens, camera_ids
from snowsplat.sfm.colmap.mapping.mapping import Mapping
from snowsplat.sfm.colmap.options import EFFORTS
from snowsplat.sfm.colmap.pairs.choice import PairChoice
from snowsplat.sfm.colmap.reconstruct import PoseEstimation
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent

from .. import walks

pytestmark = pytest.mark.sfm

ALTERNATE = np.tile([1.0, 1.6], 6)
WALK = walks.sideways(points=500)
RADIAL = Lens("SIMPLE_RADIAL")


def mapped(folder, walk, grouping=list):
    """The model of a walk, with the cameras of ``grouping``."""
    database = walk.write(folder / "database.db", None, RADIAL)
    set_cameras(database, grouping(walk.photos(None)), RADIAL)
    return Mapping(database, folder, 1.0, 1, silent).run("incremental")[0]


def attempted(folder, walk, exif=None):
    """The attempts of `PoseEstimation` up to that with several focal lengths."""
    photos = walk.photos(exif)
    dataset = DatasetFolder(folder)
    dataset.distorted.mkdir()
    walk.write(dataset.database, exif, RADIAL)
    progress = WorkerProgress(silent)
    job = PoseEstimation(dataset, photos, SfmOptions(camera_model="SIMPLE_RADIAL"), 1, progress)
    matched = Matched(dataset.database, EFFORTS["draft"], PairChoice(list(walk.matches), ""), 1.0)
    job.matched, job.mapper, job.lens = matched, "incremental", RADIAL
    job.evidence = gather_evidence(dataset.database, photos, 100)
    job._try()
    job._try_zooms()
    return job


def test_photos_of_two_zooms_get_two_cameras(tmp_path):
    walk = walks.zoomed(WALK, ALTERNATE)
    job = attempted(tmp_path, walk)
    model = job._best().models[0]
    assert model.num_reg_images() == len(walk.centres)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda i: i.name)
    focals = [model.cameras[image.camera_id].mean_focal_length() for image in images]
    np.testing.assert_allclose(focals, walks.FOCAL * ALTERNATE, rtol=0.02)
    assert len({image.camera_id for image in images}) == 2
    steps = np.diff([image.projection_center() for image in images], axis=0)
    true = np.linalg.norm(np.diff(walk.centres, axis=0), axis=1)
    length = np.linalg.norm(steps, axis=1)
    np.testing.assert_allclose(length / length.sum(), true / true.sum(), rtol=0.05)
    assert re.fullmatch(r"focal lengths of (49|50)\d and (79|80)\d pixels", describe(model))


@pytest.mark.parametrize("walk", [WALK, walks.forward(8)], ids=["sideways", "forward"])
def test_photos_of_one_zoom_keep_their_camera(tmp_path, walk):
    job = attempted(tmp_path, walk)
    assert set(camera_ids(job.photos)) == {1}
    with pycolmap.Database.open(job.dataset.database) as database:
        assert database.num_cameras() == 1


def test_photos_of_one_zoom_gain_nothing_from_focal_lengths_of_their_own(tmp_path):
    assert own_focals(mapped(tmp_path, WALK), 1) == {}


def test_bundle_adjustment_finds_the_focal_lengths_of_a_bent_model(tmp_path):
    model = mapped(tmp_path, walks.zoomed(WALK, np.tile([1.0, 1.15], 6)))
    focals = own_focals(model, 1)
    assert len(focals) == model.num_reg_images()
    ratios = [focals[i] / focals[i + 1] for i in focals if i + 1 in focals and i % 2]
    np.testing.assert_allclose(ratios, 1 / 1.15, rtol=0.04)


def test_each_photo_of_a_slow_zoom_gets_a_camera(tmp_path):
    zooms = np.geomspace(1.0, 1.5, 12)
    walk = walks.zoomed(WALK, zooms)
    focals = focals_of(mapped(tmp_path, walk, separate))
    found = [focals[i + 1] for i in range(12)]
    np.testing.assert_allclose(found, walks.FOCAL * zooms, rtol=0.03)
    assert len(set(camera_ids(group_by_zoom(walk.photos(None), focals)))) == 12


def test_small_differences_make_no_groups():
    photos = WALK.photos(None)
    focals = {i + 1: 500 * (1 + 0.02 * (i % 3)) for i in range(12)}
    assert group_by_zoom(photos, focals) is None


def test_a_photo_without_a_focal_length_gets_a_camera_of_its_own():
    photos = WALK.photos(None)
    focals = {i + 1: 500.0 if i < 6 else 800.0 for i in range(11)}
    cameras = camera_ids(group_by_zoom(photos, focals))
    assert [cameras.count(number) for number in cameras] == [6] * 6 + [5] * 5 + [1]


def test_photos_with_exif_keep_their_camera():
    photos = WALK.photos(500.0)
    focals = {i + 1: 500.0 if i < 6 else 800.0 for i in range(12)}
    assert group_by_zoom(photos, focals) is None
    scans = [dataclasses.replace(photo, group="scan", focal=None) for photo in photos[6:]]
    assert group_by_zoom([*photos[:6], *scans], focals) is None


def test_more_cameras_alone_are_not_more_probable(tmp_path):
    (tmp_path / "one").mkdir()
    one, each = mapped(tmp_path / "one", WALK), mapped(tmp_path, WALK, separate)
    pairs = read_matches(tmp_path / "database.db")
    assert score_of(one, pairs, {}).total > score_of(each, pairs, {}).total
