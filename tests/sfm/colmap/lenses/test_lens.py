"""A lens in doubt is compared with what is known about lenses, and with that in EXIF."""

import copy
import re

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.lenses.lens import Lens, cameras_of, findings_of, settle_lens
from snowsplat.sfm.colmap.lenses.posterior import estimate_lenses
from snowsplat.sfm.colmap.mapping.mapping import Mapping
from snowsplat.sfm.progress import silent

from .. import walks

pytestmark = pytest.mark.sfm


def lens(model, params, size=(1024, 768)):
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [820.0, 512.0, 384.0]),
        ("OPENCV", [820.0, 822.0, 512.0, 384.0, 0.05, -0.08, 0.001, -0.002]),  # of a phone
        ("SIMPLE_RADIAL", [820.0, 512.0, 384.0, 0.1]),
        ("OPENCV", [600.0, 600.0, 512.0, 384.0, -0.25, 0.06, 0.0, 0.0]),  # a wide lens
        ("OPENCV_FISHEYE", [400.0, 400.0, 512.0, 384.0, 0.0, 0.0, 0.0, 0.0]),
        ("FOV", [500.0, 500.0, 512.0, 384.0, 0.9]),
        ("OPENCV_FISHEYE", [488.0, 488.0, 512.0, 384.0, 0.03, -0.008, 0.001, 0.0]),
        ("SIMPLE_FISHEYE", [224.0, 512.0, 384.0]),  # an image circle of 196°
        ("RADIAL_FISHEYE", [240.0, 512.0, 384.0, -1 / 24, 0.0]),  # equal solid angles
        ("SIMPLE_RADIAL_FISHEYE", [800.0, 512.0, 384.0, 0.33]),  # hardly a fisheye
    ],
)
def test_lenses_of_real_cameras_are_possible(model, params):
    assert findings_of(lens(model, params)) == []


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("SIMPLE_RADIAL", [820.0, 512.0, 384.0, -0.6], "not one-to-one"),
        ("SIMPLE_RADIAL", [820.0, 512.0, 384.0, 0.3], "at the border by 1[0-9]%"),
        ("OPENCV", [820.0, 820.0, 512.0, 384.0, 1.0, -1.5, 0.0, 0.0], "at the border by 17%"),
        ("OPENCV", [956.0, 950.0, 512.0, 384.0, 0.29, -0.66, 0.0, 0.0], "outwards by 3.2%"),
        ("SIMPLE_RADIAL_FISHEYE", [488.0, 512.0, 384.0, -0.4], "not one-to-one"),
        ("SIMPLE_FISHEYE", [144.0, 512.0, 384.0], "field of view of 306°"),
        ("OPENCV", [643.7, 628.5, 512.0, 384.0, -0.315, 0.08, 0.0, 0.0], "as a fisheye lens does"),
        ("OPENCV", [956.0, 920.0, 512.0, 384.0, 0.0, 0.0, 0.0, 0.0], "fx is 1.039 of fy"),
        ("SIMPLE_PINHOLE", [4.3, 512.0, 384.0], "field of view of 179"),
        ("SIMPLE_PINHOLE", [820.0, 1100.0, 384.0], r"principal point \(1100, 384\) is outside"),
    ],
)
def test_a_lens_in_doubt_is_named(model, params, message):
    (found,) = findings_of(lens(model, params))
    assert re.search(message, str(found.text))


def mapped(tmp_path, walk, exif, lens, **options):
    """The model of a walk, and `Refine` of it."""
    database = walk.write(tmp_path / "database.db", exif, lens)
    mapping = Mapping(database, tmp_path, 1.0, 1, silent, lens.held, **options)
    (model,) = mapping.run("incremental")
    return model, mapping.with_cameras


@pytest.fixture(scope="module")
def ahead(tmp_path_factory):
    """A walk in which no two photos have the angle with which COLMAP starts a model; its model."""
    walk = walks.forward()
    return walk, *mapped(tmp_path_factory.mktemp("a"), walk, 500.0, Lens(held=True), forward=True)


@pytest.fixture(scope="module")
def aside(tmp_path_factory):
    walk = walks.sideways(points=600)
    return walk, mapped(tmp_path_factory.mktemp("a"), walk, 505.0, Lens())[0]


def test_a_walk_straight_ahead(ahead):
    walk, model, _ = ahead
    assert model.num_reg_images() == len(walk.centres)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda i: i.name)
    centres = np.array([image.projection_center() for image in images])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    true = np.linalg.norm(np.diff(walk.centres, axis=0), axis=1)
    np.testing.assert_allclose(steps / steps.mean(), true / true.mean(), rtol=0.05)


def test_photos_that_do_not_determine_the_focal_length_keep_that_of_exif(ahead):
    walk, model, refine = ahead
    found = settle_lens(copy.deepcopy(model), walk.photos(500.0), Lens(held=True), refine)
    assert found.held
    assert found.notes == []
    assert found.model.cameras[1].mean_focal_length() == 500.0


@pytest.mark.parametrize(
    ("walk", "stretched"), [(walks.facing(), 1.0), (walks.sideways(points=600), 1.2)]
)
def test_pixels_are_square_unless_the_photos_show_the_contrary(tmp_path, walk, stretched):
    """1.2: an anamorphic video. The photos of a walk that faces a wall hardly tell the ratio."""
    for pixels in walk.pixels:
        pixels[:, 0] *= stretched
    model, _ = mapped(tmp_path, walk, 500.0, Lens())
    camera = estimate_lenses(model, {1: 500.0}, False, 1).cameras[1]
    ratio = camera.focal_length_x / camera.focal_length_y
    assert ratio == pytest.approx(stretched, abs=0.001 if stretched == 1 else 0.01)


@pytest.mark.parametrize("exif", [250.0, 1000.0])
def test_a_wrong_focal_length_in_exif_is_told(tmp_path, exif):
    walk = walks.sideways(points=600)
    model, refine = mapped(tmp_path, walk, exif, Lens())
    found = settle_lens(model, walk.photos(exif), Lens(), refine)
    assert not found.held
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(walks.FOCAL, rel=0.01)
    (note,) = map(str, found.notes)
    assert f"the focal length in EXIF ({exif:.0f} pixels) does not agree" in note


def test_a_right_lens_is_kept_as_it_is(aside):
    walk, model = aside
    found = settle_lens(model, walk.photos(505.0), Lens(), refine=None)
    assert found.model is model


def test_a_panorama_is_kept_as_it_is(aside):
    """It has no focal length; COLMAP ends the process if it is asked for one."""
    walk, model = aside[0], copy.deepcopy(aside[1])
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.EQUIRECTANGULAR
    camera.params = [camera.width, camera.height]
    found = settle_lens(model, walk.photos(None), Lens(), refine=None)
    assert found.model is model
    assert (found.held, found.notes) == (False, [])


def test_an_impossible_lens_is_replaced(ahead):
    """Pixels that are not square, and a distortion that no lens has."""
    walk, model, refine = ahead[0], copy.deepcopy(ahead[1]), ahead[2]
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [480.0, 460.0, 320.0, 240.0, 0.9, -1.2, 0.0, 0.0]
    found = settle_lens(model, walk.photos(None), Lens(), refine)
    assert found.held
    assert found.model.cameras[1].params[0] == cameras_of(walk.photos(None), Lens())[0].params[0]
    assert all(not finding.impossible for finding in findings_of(found.model.cameras[1]))
