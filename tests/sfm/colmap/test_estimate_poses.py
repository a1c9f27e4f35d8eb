"""Poses from small photos of known cameras, and the errors for unsuitable photos."""

import dataclasses
import json
import shutil
from contextlib import closing
from sqlite3 import connect

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.scene.geometry import similarity_from_points
from snowsplat.sfm.colmap import SfmResult, describe_model, estimate_poses
from snowsplat.sfm.colmap.options import CAMERA_MODELS
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent
from snowsplat.util.errors import UserError

from . import scenes
from .forks import children_in_forks

COUNT = 8
DRAFT = SfmOptions(effort="draft", threads=2)
#: With this zoom, a photo has many features. If it has no matches, it must show another scene.
MANY_FEATURES = 1.5
BLACK = np.zeros((scenes.HEIGHT, scenes.WIDTH), np.uint8)

pytestmark = pytest.mark.sfm


@pytest.fixture(scope="module", autouse=True)
def _forks():
    with children_in_forks():
        yield


@pytest.fixture(scope="module")
def pictures():
    """Photos along an arc: just enough for the camera model OPENCV."""
    boards = scenes.boards()
    return [scenes.photograph(boards, pose, i) for i, pose in enumerate(scenes.arc(COUNT))]


@pytest.fixture(scope="module")
def done(tmp_path_factory, pictures):
    """A dataset with poses, in a folder with an unusual name; read-only for the tests."""
    dataset = tmp_path_factory.mktemp("Größe 10 – ä b")
    names = [f"ünter weg/{i} b.png" for i in range(COUNT)]
    photos = [
        scenes.save(dataset, name, image) for name, image in zip(names, pictures, strict=True)
    ]
    calls = []
    result = estimate_poses(dataset, photos, DRAFT, lambda *call: calls.append(call))
    return dataset, photos, result, calls


def centres(model, photos):
    images = {image.name: image for image in model.images.values()}
    return np.stack([images[photo.name].projection_center() for photo in photos])


def test_poses_are_those_of_the_cameras(done):
    dataset, photos, result, _ = done
    assert result.registered == sorted(photo.name for photo in photos)
    assert result.unregistered == {}
    assert result.sub_models == [COUNT]
    assert 0 < result.reprojection_error < 0.3
    model = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    truth = np.stack([-pose[:, :3].T @ pose[:, 3] for pose in scenes.arc(COUNT)])
    found, truth = torch.tensor(centres(model, photos)), torch.tensor(truth)
    error = (similarity_from_points(found, truth).apply(found) - truth).norm(dim=1)
    assert error.max() < 0.01 * (truth - truth.mean(0)).norm(dim=1).max()
    assert (result.points, result.observations) == (
        model.num_points3D(),
        model.compute_num_observations(),
    )
    (camera,) = result.cameras
    assert (camera["model"], camera["focal_from"], camera["images"]) == ("OPENCV", "guessed", COUNT)
    assert abs(camera["params"][0] / scenes.FOCAL - 1) < 0.03


def test_points_that_only_two_photos_see_are_on_the_boards(done):
    dataset, photos, result, _ = done
    model = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    truth = np.stack([-pose[:, :3].T @ pose[:, 3] for pose in scenes.arc(COUNT)])
    to_truth = similarity_from_points(torch.tensor(centres(model, photos)), torch.tensor(truth))
    points = list(model.points3D.values())
    found = to_truth.apply(torch.tensor(np.stack([point.xyz for point in points]))).numpy()
    distances = []
    for board in scenes.boards():
        normal = np.cross(board.right, board.down)
        distances.append(np.abs((found - board.corner) @ normal) / np.linalg.norm(normal))
    distance = np.min(distances, axis=0)
    few = np.array([point.track.length() == 2 for point in points])
    assert few.mean() > 0.1
    assert np.median(distance[few]) < 0.02
    errors = np.array([point.error for point in points])
    assert result.reprojection_error == pytest.approx(errors[~few].mean())


def test_result_fits_json(done):
    result = done[2]
    assert SfmResult(**json.loads(json.dumps(dataclasses.asdict(result)))) == result


def test_progress_has_all_steps_in_order(done):
    calls = done[3]
    assert list(dict.fromkeys(what for _, _, what in calls)) == [
        "photos with features",
        "matched pairs",
        "verified pairs",
        "registered photos",
    ]
    assert all(0 <= done <= total for done, total, _ in calls)
    assert (COUNT, COUNT, "photos with features") in calls
    assert (28, 28, "verified pairs") in calls
    assert calls[-1] == (COUNT, COUNT, "registered photos")


def test_an_existing_model_is_described(done):
    dataset, photos, result, _ = done
    described = describe_model(dataset, photos)
    for name in ("registered", "points", "observations", "sub_models", "cameras"):
        assert getattr(described, name) == getattr(result, name)
    assert described.reprojection_error == pytest.approx(result.reprojection_error, rel=1e-6)
    other = dataclasses.replace(photos[0], name="other.png")
    assert "other.png" in describe_model(dataset, [*photos, other]).unregistered
    with pytest.raises(UserError, match="none of the photos"):
        describe_model(dataset, [other])
    with pytest.raises(UserError, match="skip_matching: there is no COLMAP model"):
        describe_model(dataset / "input", photos)


def test_camera_model_focal_length_and_mapper_are_as_given(tmp_path, pictures):
    photos = scenes.write(tmp_path, pictures[2:6], focal=scenes.FOCAL)
    options = dataclasses.replace(DRAFT, camera_model="RADIAL", mapper="global", threads=1)
    result = estimate_poses(tmp_path, photos, options, silent)
    (camera,) = result.cameras
    assert (camera["model"], camera["focal_from"]) == ("RADIAL", "exif")
    assert len(result.registered) == 4
    assert "global" in result.attempts[0]


def test_unknown_camera_model(tmp_path, pictures):
    photos = scenes.write(tmp_path, pictures[:3])
    options = dataclasses.replace(DRAFT, camera_model="OPENVC")
    with pytest.raises(UserError, match="camera_model: unknown value 'OPENVC'; .*auto, .*OPENCV"):
        estimate_poses(tmp_path, photos, options, silent)


@pytest.mark.parametrize("camera_model", CAMERA_MODELS)
def test_camera_models_are_known_to_colmap(camera_model):
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, 500.0, 640, 480)
    if camera.is_spherical():  # becomes several views
        return
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    assert pinhole.model_name == "PINHOLE"


def test_masked_areas_have_no_features(tmp_path, pictures):
    """Two of three photos have their left half masked, so their features are on the right."""
    photos = scenes.write(tmp_path, pictures[:3])
    masks = tmp_path / "distorted" / "masks"
    masks.mkdir(parents=True)
    mask = np.full((scenes.HEIGHT, scenes.WIDTH), 255, np.uint8)
    mask[:, : scenes.WIDTH // 2] = 0
    for photo in photos[:2]:
        Image.fromarray(mask).save(masks / f"{photo.name}.png")
    photos = [dataclasses.replace(photo, mask=i < 2) for i, photo in enumerate(photos)]
    estimate_poses(tmp_path, photos, DRAFT, silent)
    database = pycolmap.Database.open(tmp_path / "distorted" / "database.db")
    leftmost = [database.read_keypoints(i)[:, 0].min() for i in (1, 2, 3)]
    database.close()
    assert min(leftmost[:2]) > scenes.WIDTH / 2 - 1
    assert leftmost[2] < scenes.WIDTH / 4


def test_photos_of_another_scene_are_named(tmp_path, pictures):
    stranger = scenes.photograph(scenes.boards(7), scenes.arc(3)[1], zoom=MANY_FEATURES)
    photos = scenes.write(tmp_path, [*pictures[2:7], BLACK, stranger])
    result = estimate_poses(tmp_path, photos, DRAFT, silent)
    assert len(result.registered) == 5
    assert "hardly any detail" in str(result.unregistered["005.png"])
    assert str(result.unregistered["006.png"]) == "it matches no other photo"
    # More effort cannot add these two photos, so there is no second attempt.
    assert len(result.attempts) == 1


def test_two_scenes_yield_the_larger_one_after_a_second_attempt(tmp_path, pictures):
    other = [scenes.photograph(scenes.boards(9), pose, i) for i, pose in enumerate(scenes.arc(3))]
    photos = scenes.write(tmp_path, [*other, *pictures[2:6]])
    result = estimate_poses(tmp_path, photos, DRAFT, silent)
    assert result.registered == [f"{i:03}.png" for i in range(3, 7)]
    assert result.sub_models == [4, 3]
    assert "a separate group of 3 photos" in str(result.unregistered["000.png"])
    assert len(result.attempts) > 1
    assert any("4096 features" in attempt for attempt in result.attempts[1:])
    sparse = tmp_path / "distorted" / "sparse"
    assert sorted(path.name for path in sparse.iterdir()) == ["0", "1"]
    left = {path.name for path in (tmp_path / "distorted").iterdir()}
    assert left == {"colmap.log", "database.db", "sparse"}


def rotating(count):
    return [
        scenes.look((0, 0, 0), (5 * np.sin(angle), 0, 5 * np.cos(angle)))
        for angle in np.linspace(-0.4, 0.4, count)
    ]


@pytest.mark.parametrize(
    ("poses", "message", "mapper"),
    [
        ([scenes.arc(3)[1]] * 3, "the camera hardly moved between the photos", "global"),
        (rotating(5), "only rotated", "incremental"),
    ],
    ids=["static", "rotating"],
)
def test_camera_that_did_not_move(tmp_path, poses, message, mapper):
    boards = scenes.boards()
    photos = scenes.write(
        tmp_path, [scenes.photograph(boards, pose, i) for i, pose in enumerate(poses)]
    )
    with pytest.raises(UserError, match=message):
        estimate_poses(tmp_path, photos, dataclasses.replace(DRAFT, mapper=mapper), silent)
    assert not (tmp_path / "distorted" / "sparse").exists()


def test_two_photos(tmp_path, pictures):
    with pytest.raises(UserError, match="photos: 2 are not enough"):
        estimate_poses(tmp_path, scenes.write(tmp_path, pictures[:2]), DRAFT, silent)


def test_a_flat_wall_is_reconstructed(tmp_path):
    flat = [scenes.photograph(scenes.wall(), pose, i) for i, pose in enumerate(scenes.arc(5))]
    result = estimate_poses(tmp_path, scenes.write(tmp_path, flat), DRAFT, silent)
    assert len(result.registered) == 5


def test_log_and_repeated_runs(done, tmp_path, pictures, capfd):
    dataset, photos, result, _ = done
    shutil.copytree(dataset, tmp_path, dirs_exist_ok=True)
    assert "Loading rigs" in (tmp_path / "distorted" / "colmap.log").read_text()
    left = {path.name for path in (tmp_path / "distorted").iterdir()}
    assert left == {"colmap.log", "database.db", "sparse"}
    # Features and matches are reused, and COLMAP prints to its log only.
    calls = []
    again = estimate_poses(tmp_path, photos, DRAFT, lambda *call: calls.append(call))
    assert capfd.readouterr() == ("", "")
    assert calls[0] == (COUNT, COUNT, "photos with features")
    assert next(call for call in calls if call[2] == "verified pairs") == (28, 28, "verified pairs")
    assert again.pairs == result.pairs
    assert again.registered == result.registered
    first, second = (
        centres(pycolmap.Reconstruction(folder / "distorted" / "sparse" / "0"), photos)
        for folder in (dataset, tmp_path)
    )
    assert np.abs(first - second).max() < 1e-3

    # A changed photo is noticed.
    def begun(*call):
        calls.append(call)
        raise KeyboardInterrupt

    scenes.save(tmp_path, photos[0].name, pictures[5])
    calls.clear()
    with pytest.raises(KeyboardInterrupt):
        estimate_poses(tmp_path, photos, DRAFT, begun)
    assert calls == [(0, COUNT, "photos with features")]
    with closing(connect(tmp_path / "distorted" / "database.db")) as connection:
        assert connection.execute("SELECT COUNT(*) FROM images").fetchone() == (COUNT,)
