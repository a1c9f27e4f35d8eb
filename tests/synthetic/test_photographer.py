"""Photos of the still life agree with their poses to a fraction of a pixel."""

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data.colmap.model import read_model
from snowsplat.scene.geometry import rotation_from_quat, transform_points
from snowsplat.synthetic import write_synthetic_photos
from snowsplat.synthetic.photographer import Lens, photograph, walk
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum, Ring

from ..scenes.coarse import coarse_still_life

pytestmark = pytest.mark.slow

DISTORTIONS = [
    (0.0, 0.0, 0.0, 0.0),
    (-0.062, 0.021, 0.00015, -0.0001),
    (0.08, -0.03, 0.002, -0.001),
]


@pytest.fixture(scope="module")
def coarse_scene():
    with pytest.MonkeyPatch.context() as patch:
        coarse_still_life(patch)
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory, coarse_scene):
    folder = tmp_path_factory.mktemp("photos")
    return folder, write_synthetic_photos(folder, n_views=3, width=96, height=64, seed=1)


def test_photos_are_like_those_of_a_phone(photos):
    folder, truth = photos
    names = ["IMG_0001.jpg", "IMG_0002.jpg", "IMG_0003.jpg"]
    assert sorted(path.name for path in folder.iterdir()) == names == list(truth.poses)
    for name in names:
        with Image.open(folder / name) as image:
            assert (image.format, image.size) == ("JPEG", (96, 64))
            assert image.getexif().get_ifd(0x8769)[0xA405] == 28  # FocalLengthIn35mmFilm
            pixels = np.asarray(image, np.float64)
        assert pixels.std() > 30  # the photo has content
        assert 60 < pixels.mean() < 180  # and a normal exposure
    # The focal length in EXIF is close to the true one, but not equal.
    focal = 28 * np.hypot(96, 64) / np.hypot(36, 24)
    assert truth.lens.focal == pytest.approx(focal, rel=0.03)
    assert truth.lens.focal != pytest.approx(focal, rel=0.005)


def test_existing_photos_are_kept_and_the_others_are_reproduced(photos, tmp_path):
    folder, truth = photos
    (tmp_path / "IMG_0001.jpg").write_bytes(b"mine")
    calls = []
    again = write_synthetic_photos(tmp_path, 3, 96, 64, 1, report=lambda *call: calls.append(call))
    assert (tmp_path / "IMG_0001.jpg").read_bytes() == b"mine"
    for name in ("IMG_0002.jpg", "IMG_0003.jpg"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    for name, pose in truth.poses.items():
        assert torch.equal(again.poses[name], pose)
    assert calls[-1] == (2, 2, "photos")


def test_the_truth_is_written_as_a_colmap_model(photos, tmp_path):
    _, truth = photos
    truth.write(tmp_path)
    model = read_model(tmp_path)
    assert model.cameras[1].model == "OPENCV"
    assert model.cameras[1].params == truth.lens.params
    for image in model.images:
        quat, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
        pose = torch.cat([rotation_from_quat(quat), translation[:, None]], 1)
        assert torch.allclose(pose, truth.poses[image.name], atol=1e-12)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_lens_directions_are_the_inverse_of_project(distortion):
    lens = Lens(640, 480, 525.0, distortion)
    pixels = np.random.default_rng(0).uniform([[0], [0]], [[640], [480]], (2, 500))
    directions = lens.directions(pixels)
    assert np.allclose(np.linalg.norm(directions, axis=0), 1)
    assert np.abs(lens.project(5 * directions) - pixels).max() < 1e-9


def test_lens_is_colmaps_opencv_model():
    pycolmap = pytest.importorskip("pycolmap")
    lens = Lens(640, 480, 525.0, DISTORTIONS[2])
    camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=lens.params)
    points = np.random.default_rng(1).uniform([[-1], [-0.8], [1.6]], [[1], [0.8], [3]], (3, 100))
    assert np.allclose(camera.img_from_cam(points.T), lens.project(points).T, atol=1e-9)


@pytest.mark.parametrize("distortion", DISTORTIONS[1:])
def test_marks_are_where_the_poses_project_them(distortion):
    """Small emissive balls in the dark: the centres of their images against their projections."""
    lens = Lens(320, 240, 262.0, distortion)
    marks = [(0, 0, 0), (0.5, 0.2, 0.1), (-0.4, 0.3, 0.3), (0.1, -0.5, -0.2), (-0.45, -0.35, 0.2)]
    white = np.ones((16, 16, 3), np.float32)
    balls = [SceneObject(Ellipsoid(mark, (0.02,) * 3), [white], emissive=True) for mark in marks]
    scene = Scene(balls, Lamp((0, 0, 9), (1, 1), 0.0, 0.0))
    errors = []
    for pose in walk(6, seed=5):
        image = photograph(scene, lens, pose, np.random.default_rng(0))[..., 1]
        x_cam = transform_points(pose, torch.tensor(marks, dtype=torch.float64)).numpy().T
        spots = lens.project(x_cam)
        apart = np.linalg.norm(spots[:, :, None] - spots[:, None], axis=0) + 1e9 * np.eye(5)
        for x, y in spots[:, apart.min(axis=0) > 24].T:
            if not (10 < x < 310 and 10 < y < 230):
                continue
            rows, columns = slice(int(y) - 9, int(y) + 10), slice(int(x) - 9, int(x) + 10)
            bright = (image[rows, columns] / 255.0) ** 2.2
            bright[bright < 0.05] = 0  # noise
            seen_x = (bright.sum(0) * (np.arange(columns.start, columns.stop) + 0.5)).sum()
            seen_y = (bright.sum(1) * (np.arange(rows.start, rows.stop) + 0.5)).sum()
            errors.append((seen_x / bright.sum() - x, seen_y / bright.sum() - y))
    # With four rays per pixel, the centre of a spot is exact to a tenth of a pixel, without bias.
    assert len(errors) > 24
    assert np.abs(errors).max() < 0.15
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


SHAPES = [
    Box((0.1, -0.2, 0.3), (0.6, 0.4, 0.5), angle=0.7),
    Box((0.1, -0.2, 0.3), (4.0, 5.0, 6.0), angle=0.2, inside=True),
    Ellipsoid((0.1, 0.2, -0.1), (0.3, 0.4, 0.5)),
    Frustum((0.0, 0.1, -0.3), 0.6, 0.4, 0.2),
    Ring((0.1, 0.0, 0.0), 0.4, 0.1),
    Ring((0.1, 0.0, 0.0), 0.4, 0.1, upright=True, angle=0.8),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_surface_of_a_shape(shape):
    """`points`, `surface` and `hit` are consistent."""
    random = np.random.default_rng(2)
    for face in range(len(shape.sizes)):
        uv = random.uniform(0.05, 0.95, (2, 200)).astype(np.float32)
        if isinstance(shape, Frustum) and face > 0:
            uv = uv[:, np.linalg.norm(uv - 0.5, axis=0) < 0.45]  # caps are round
        positions, normals = shape.points(face, uv)
        assert np.allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-5)
        faces, uv_back, normals_back = shape.surface(positions)
        assert (faces == face).all()
        assert np.allclose(uv_back, uv, atol=1e-4)
        assert np.allclose(normals_back, normals, atol=1e-3)
        # A ray from slightly above each point along its normal hits that point.
        distance = shape.hit(positions + np.float32(0.05) * normals, -normals)
        assert np.allclose(distance, 0.05, atol=1e-3)


def test_rays_that_miss_a_shape():
    away = np.array([[0.0], [0.0], [1.0]], np.float32)
    for shape in SHAPES:
        distance = shape.hit(np.array([[0.05], [0.0], [2.0]], np.float32), away)
        assert np.isinf(distance).all() != getattr(shape, "inside", False)


def test_nearer_objects_occlude_and_shade_others():
    grey = np.full((16, 16, 3), 0.5, np.float32)
    floor = SceneObject(Box((0, 0, -0.05), (4.0, 4.0, 0.1)), [grey])
    ball = SceneObject(Ellipsoid((0, 0, 0.5), (0.3, 0.3, 0.3)), [grey])
    lamp = Lamp((0, 0, 3), (0.2, 0.2), 5.0, 0.2)
    down = np.array([[0.0, 1.2], [0.0, 0.0], [-1.0, -1.0]], np.float32)
    below = np.array([[0.0, 1.2], [0.0, 0.0], [0.1, 0.1]], np.float32)
    with_ball, without = Scene([floor, ball], lamp), Scene([floor], lamp)
    shaded, lit = with_ball.radiance(below, down, 1e-3), without.radiance(below, down, 1e-3)
    assert (shaded[:, 0] < 0.3 * lit[:, 0]).all()
    assert np.allclose(shaded[:, 1], lit[:, 1], rtol=0.15)
