"""Photos of a fisheye lens are recognised by their matches, and their poses are found."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.scene.epipolar import distances_of_matches
from snowsplat.sfm.colmap.checks.consistency import agreement_of, check_pairs
from snowsplat.sfm.colmap.database import closing_database
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses.fisheye import (
    describe_fisheye,
    doubts_about_fisheye,
    lens_evidence,
)
from snowsplat.sfm.colmap.lenses.lens import Lens, cameras_of, findings_of, with_all_parameters
from snowsplat.sfm.colmap.mapping.mapping import Mapping
from snowsplat.sfm.colmap.options import CAMERA_MODELS
from snowsplat.sfm.colmap.reconstruct import PoseEstimation
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent
from snowsplat.synthetic.photographer import Lens as PhoneLens

from ....scenes.lenses import FisheyeLens
from .. import walks

pytestmark = pytest.mark.sfm

# 150° from corner to corner, and an action camera's distortion.
FISHEYE = FisheyeLens(walks.WIDTH, walks.HEIGHT, 305.0, (0.03, -0.008, 0.001, 0.0))
WALK = walks.sideways(8, 700, FISHEYE)
# A disc that spans 214°.
WIDE = FisheyeLens(walks.WIDTH, walks.HEIGHT, 128.5, (0.0, 0.0, 0.0, 0.0))
BARREL = PhoneLens(walks.WIDTH, walks.HEIGHT, 500.0, (-0.2, 0.05, 0.0, 0.0))


def evidence_of(tmp_path, walk):
    database = walk.write(tmp_path / "database.db", None, Lens())
    random = np.random.default_rng(0)
    with closing_database(database) as opened:
        for (i, j), rows in walk.matches.items():
            false = [random.integers(len(walk.pixels[k]), size=len(rows) // 4) for k in (i, j)]
            both = np.concatenate([rows, np.stack(false, 1).astype(np.uint32)])
            opened.write_matches(i + 1, j + 1, both)
    return lens_evidence(database, walk.photos(None), 1.0)[1]


def test_the_matches_of_a_fisheye_lens(tmp_path):
    found = evidence_of(tmp_path, WALK)
    assert found.fisheye
    assert found.focal == pytest.approx(FISHEYE.focal, rel=0.2)


@pytest.mark.parametrize("lens", [walks.ORDINARY, BARREL])
def test_the_matches_of_an_ordinary_lens(tmp_path, lens):
    assert not evidence_of(tmp_path, walks.sideways(8, 700, lens)).fisheye


def mapped(tmp_path, lens):
    database = WALK.write(tmp_path / "database.db", None, lens)
    mapping = Mapping(database, tmp_path, 1.0, 1, silent)
    model = mapping.run("incremental")[0]
    photos = WALK.photos(None)
    return with_all_parameters(model, photos, lens, mapping.with_cameras, False), database


@pytest.mark.parametrize(
    "lens",
    [
        Lens("RADIAL_FISHEYE"),
        Lens(fisheyes=frozenset([1]), focals={1: 200.0}),
    ],
)
def test_photos_of_a_fisheye_lens_are_placed(tmp_path, lens):
    model, database = mapped(tmp_path, lens)
    (camera,) = model.cameras.values()
    assert camera.model_name == ("OPENCV_FISHEYE" if lens.model == "auto" else lens.model)
    assert camera.mean_focal_length() == pytest.approx(FISHEYE.focal, rel=0.01)
    assert findings_of(camera) == []
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda i: i.name)
    centres = np.array([image.projection_center() for image in images])
    steps, true = (np.linalg.norm(c[:, None] - c[None], axis=-1) for c in (centres, WALK.centres))
    np.testing.assert_allclose(steps / steps.max(), true / true.max(), atol=0.005)
    assert agreement_of(check_pairs(model, database, 4.0)) > 0.99


def test_a_lens_whose_picture_is_a_disc_begins_near_its_focal_length(tmp_path):
    walk = walks.sideways(8, 700, WIDE)
    photos = [replace(photo, circle=240.0) for photo in walk.photos(None)]
    job = PoseEstimation(DatasetFolder(tmp_path), photos, SfmOptions(), 1, WorkerProgress(silent))
    lens = job._first_lens()  # without evidence from matches
    assert lens.fisheyes == {1}
    database = walk.write(tmp_path / "database.db", None, lens)
    model = Mapping(database, tmp_path, 1.0, 1, silent).run("incremental")[0]
    assert model.num_reg_images() == 8
    (camera,) = model.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(WIDE.focal, rel=0.01)
    # The matches of an ordinary attempt, which contradict its poses, do not hide the disc.
    (doubt,) = doubts_about_fisheye(Lens(), photos, {}, bent=True)
    assert "from a fisheye lens, but" in str(doubt)
    assert doubts_about_fisheye(Lens(), photos, {}, bent=False) == []
    found = describe_fisheye(lens, photos, {})
    assert found == "the photos are from a fisheye lens: the picture is a disc"


def test_a_fisheye_lens_begins_with_few_parameters_and_a_prior():
    for name in CAMERA_MODELS:
        (camera,) = cameras_of(WALK.photos(None), Lens(name))
        assert camera.has_prior_focal_length == name.endswith("FISHEYE")
        assert len(camera.extra_params_idxs()) <= 1 or not camera.has_prior_focal_length


def test_matches_behind_the_camera_agree_with_their_pose():
    """A fisheye lens of 190° sees points at an angle of 95°."""
    random = np.random.default_rng(0)
    points = random.normal(size=(200, 3)) * [5.0, 5.0, 1.0]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.0])), np.array([1.0, 0, 0]))
    others = points @ pose.rotation.matrix().T + pose.translation
    rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, others)]
    assert (points[:, 2] < 0).sum() > 50
    rotation = pose.rotation.matrix()
    assert distances_of_matches(rotation, pose.translation, *rays).max() <= 1e-9
    wrong = distances_of_matches(rotation, np.array([0.0, 1.0, 0.0]), *rays)
    assert np.mean(wrong <= 1e-3) < 0.1
