"""COLMAP's files: round trips, camera models, several models, damaged files."""

import logging
import struct

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.data.colmap import types
from snowsplat.data.colmap.model import posed_camera, read_model, read_points, write_model
from snowsplat.data.colmap.types import ColmapImage, ColmapModel
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError

POSE = (0.5, -0.5, 0.5, 0.5, 1.25, -2.5, 1e-3)


@pytest.mark.parametrize("text", [False, True])
def test_model_round_trip(tmp_path, text):
    random = np.random.default_rng(0)
    cameras = {
        7: lens_of("PINHOLE", 640, 480, (500.5, 501.5, 320.25, 239.75)),
        2: lens_of("OPENCV", 100, 90, (80.0, 81.0, 50.0, 45.0, 0.1, 0.0, 0.0, -0.2)),
    }
    images = [ColmapImage("a b/ä.jpg", 7, POSE), ColmapImage("c.png", 2, (1.0, *[0.1] * 6))]
    xyz = random.normal(size=(50, 3)).astype(np.float32)
    rgb = random.integers(0, 256, (50, 3)).astype(np.uint8)
    tracks = [[(1, i)] * int(random.integers(0, 6)) for i in range(50)]
    write_model(tmp_path, cameras, images, xyz, rgb, tracks, text=text)
    model = read_model(tmp_path)
    assert model.text == text
    assert model.cameras == cameras
    assert list(model.images) == images
    points = read_points(tmp_path)
    assert torch.equal(points.xyz, torch.from_numpy(xyz))
    assert torch.equal(points.rgb, torch.from_numpy(rgb))


@pytest.mark.parametrize("text", [False, True])
def test_model_without_points(tmp_path, text):
    images = [ColmapImage("a", 1, POSE)]
    write_model(tmp_path, {}, images, np.empty((0, 3)), np.empty((0, 3), np.uint8), text=text)
    assert read_points(tmp_path) is None


def test_observations_are_skipped(tmp_path):
    """COLMAP writes, for each image, the points that it observes."""
    write_model(tmp_path, {}, [], np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    record = struct.pack("<I7dI", 1, *POSE, 3) + b"x.jpg\0" + struct.pack("<Q", 2) + bytes(48)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2) + record * 2)
    assert list(read_model(tmp_path).images) == [ColmapImage("x.jpg", 3, POSE)] * 2
    line = "1 " + " ".join(map(str, POSE)) + " 3 x.jpg\n"
    for file in tmp_path.iterdir():
        file.unlink()
    (tmp_path / "cameras.txt").write_text("# none\n")
    (tmp_path / "images.txt").write_text("# head\n" + (line + "1.5 2.5 -1 3 4 17\n") + line)
    assert list(read_model(tmp_path).images) == [ColmapImage("x.jpg", 3, POSE)] * 2


def test_pose_is_cam_from_world_of_the_quaternion(dataset_copy):
    folder = dataset_copy("colmap-bin")
    image = read_model(folder / "sparse/0").images[1]
    camera = load_dataset(folder, hold_out=None).train[1].camera
    rotation = rotation_from_quat(torch.tensor(image.pose[:4], dtype=torch.float64))
    torch.testing.assert_close(camera.cam_from_world[:, :3], rotation, atol=1e-15, rtol=0)
    assert camera.cam_from_world[:, 3].tolist() == list(image.pose[4:])


def rewrite_cameras(folder, model, params):
    colmap = read_model(folder / "sparse/0")
    camera = lens_of(model, 32, 24, params)
    nothing = np.empty((0, 3))
    write_model(folder / "sparse/0", {1: camera}, colmap.images, nothing, nothing)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (30.0, 16.0, 12.0)),
        ("PINHOLE", (30.0, 35.0, 16.0, 12.0)),
        ("SIMPLE_RADIAL", (30.0, 16.0, 12.0, 0.0)),
        ("RADIAL", (30.0, 16.0, 12.0, 0.0, 0.0)),
        ("OPENCV", (30.0, 35.0, 16.0, 12.0, 0.0, 0.0, 0.0, 0.0)),
        ("FULL_OPENCV", (30.0, 35.0, 16.0, 12.0, *[0.0] * 8)),
    ],
)
def test_models_with_zero_distortion_are_pinhole_cameras(dataset_copy, model, params):
    folder = dataset_copy("colmap-bin")
    rewrite_cameras(folder, model, params)
    camera = load_dataset(folder).train[0].camera
    fy = params[1] if params[1] != 16.0 else 30.0
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, fy, 16.0, 12.0)


@pytest.mark.parametrize(
    "params", [(0.0, 16.0, 12.0), (-1.0, 16.0, 12.0), (float("nan"), 1.0, 1.0), (1e300, 1.0, 1.0)]
)
def test_invalid_intrinsics_are_rejected(dataset_copy, params):
    folder = dataset_copy("colmap-bin")
    rewrite_cameras(folder, "SIMPLE_PINHOLE", params)
    with pytest.raises(UserError, match="intrinsics"):
        load_dataset(folder)


def test_one_camera_per_image(dataset_copy):
    folder = dataset_copy("colmap-txt")
    model = read_model(folder / "sparse/0")
    cameras = {i: lens_of("PINHOLE", 32, 24, (30.0 + i, 30, 16, 12)) for i in range(9)}
    images = [ColmapImage(v.name, i, v.pose) for i, v in enumerate(model.images)]
    nothing = np.empty((0, 3))
    write_model(folder / "sparse/0", cameras, images, nothing, nothing, text=True)
    views = load_dataset(folder, hold_out=None).train
    assert [view.camera.fx for view in views] == [30.0 + i for i in range(9)]


@pytest.mark.parametrize("kind", ["colmap-bin", "colmap-txt"])
def test_the_model_with_most_images_is_used(dataset_copy, caplog, kind):
    folder = dataset_copy(kind)
    model = read_model(folder / "sparse/0")
    (folder / "sparse/0").rename(folder / "sparse/3")
    nothing = np.empty((0, 3))
    for number in (0, 1):  # these models are first by name, but have fewer images
        some = model.images[: 2 + number]
        write_model(folder / f"sparse/{number}", model.cameras, some, nothing, nothing)
    with caplog.at_level(logging.WARNING):
        dataset = load_dataset(folder)
    assert len(dataset.train) + len(dataset.test) == 9
    assert "sparse/3 (9 images), not sparse/1 (3), sparse/0 (2)" in caplog.text
    assert "sparse/3" in str(dataset.description)


@pytest.mark.parametrize(("kind", "name"), [("colmap-bin", "binary"), ("colmap-txt", "text")])
def test_the_description_names_the_model_and_its_kind(pristine, kind, name):
    assert str(load_dataset(pristine[kind]).description) == f"COLMAP model sparse/0 ({name})"


def test_a_model_directly_in_sparse(dataset_copy):
    folder = dataset_copy("colmap-bin")
    (folder / "sparse/0").rename(folder / "elsewhere")
    (folder / "sparse").rmdir()
    (folder / "elsewhere").rename(folder / "sparse")
    assert len(load_dataset(folder).train) == 7


def test_a_model_in_colmap_sparse(dataset_copy):
    """There nerfstudio keeps the model; a dataset without transforms.json uses it."""
    folder = dataset_copy("colmap-bin")
    (folder / "colmap").mkdir()
    (folder / "sparse").rename(folder / "colmap/sparse")
    assert str(load_dataset(folder).description) == "COLMAP model colmap/sparse/0 (binary)"


def test_missing_images_are_skipped_and_counted(dataset_copy, caplog):
    folder = dataset_copy("colmap-bin")
    (folder / "images/view_03.png").unlink()
    (folder / "images/view_05.png").unlink()
    with caplog.at_level(logging.WARNING):
        dataset = load_dataset(folder, hold_out=None)
    assert len(dataset.train) == 7
    assert "2 of 9 images are missing (the first is 'view_03.png')" in caplog.text


def test_no_images(dataset_copy):
    folder = dataset_copy("colmap-bin")
    with pytest.raises(
        UserError, match=r"images: no such folder: .*photos; .*existing folders: images, sparse"
    ):
        load_dataset(folder, images="photos")
    for image in (folder / "images").iterdir():
        image.unlink()
    with pytest.raises(UserError, match="images: .* has none of the 9 images of the model"):
        load_dataset(folder)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_points_that_are_not_finite_are_skipped(tmp_path, caplog, suffix):
    xyz = np.array([[0, 0, 1.0], [0, np.nan, 1], [1e300, 0, 0], [1, 2, 3], [0, -1e20, 0]])
    rgb = np.arange(15, dtype=np.uint8).reshape(5, 3)
    write_model(tmp_path, {}, [], xyz, rgb, text=suffix == "txt")
    with caplog.at_level(logging.WARNING):
        points = read_points(tmp_path)
    assert points.xyz.tolist() == [[0, 0, 1], [1, 2, 3]]
    assert points.rgb.tolist() == rgb[[0, 3]].tolist()
    assert f"points3D.{suffix}: skipped 3 points that are not finite or too far" in caplog.text


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("count", [2**63, 2**40, 10**6, 10])
def test_a_count_larger_than_the_file_allocates_nothing(dataset_copy, file, count):
    folder = dataset_copy("colmap-bin")
    path = folder / "sparse/0" / file
    count += struct.unpack("<Q", path.read_bytes()[:8])[0]
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    kind = {"points3D.bin": "points"}.get(file, file.removesuffix(".bin"))
    problem = f"{file}: damaged: it declares {count} {kind}, more than fit into it"
    if kind == "points" and count < 100:  # they would fit if no point had a track
        problem = f"{file}: damaged: it is truncated"
    with pytest.raises(UserError, match=problem):
        load_dataset(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_every_truncation_is_an_error(dataset_copy, name):
    """Damaged text files are read by the tests in tests/fuzz."""
    folder = dataset_copy("colmap-bin")
    path = folder / f"sparse/0/{name}.bin"
    content = path.read_bytes()
    for twentieth in range(20):
        path.write_bytes(content[: len(content) * twentieth // 20])
        with pytest.raises(UserError):
            load_dataset(folder)


def test_a_text_file_with_fewer_records_than_its_comment_declares(dataset_copy, caplog):
    folder = dataset_copy("colmap-txt")
    path = folder / "sparse/0/points3D.txt"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:41]))
    for kind, declared in (("cameras", 1), ("images", 9)):
        path = folder / "sparse/0" / f"{kind}.txt"
        path.write_text(path.read_text().replace(f"{kind}: {declared}", f"{kind}: 12"))
    with caplog.at_level(logging.WARNING):
        assert len(load_dataset(folder).points) == 40
    assert "1 cameras, but its comment declares 12" in caplog.text
    assert "9 images, but its comment declares 12" in caplog.text
    assert "40 points, but its comment declares 60" in caplog.text


@pytest.mark.parametrize(
    ("colour", "valid"),
    [("0 0 0", True), ("255 255 255", True), ("0 -1 0", False), ("0 0 256", False)],
)
def test_colours_of_points_in_text_files(dataset_copy, colour, valid):
    folder = dataset_copy("colmap-txt")
    (folder / "sparse/0/points3D.txt").write_text(f"1 0.5 1.5 2.5 {colour} 0\n")
    if valid:
        assert read_points(folder / "sparse/0").rgb.tolist() == [[int(colour.split()[0])] * 3]
    else:
        with pytest.raises(UserError, match=r"a colour is outside 0\.\.255"):
            read_points(folder / "sparse/0")


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_damaged_utf16(dataset_copy, name):
    folder = dataset_copy("colmap-txt")
    (folder / "sparse/0" / name).write_bytes(b"\xfe\xff\x00")
    with pytest.raises(UserError, match=name):
        load_dataset(folder)


@pytest.mark.parametrize("track", ["1", "1 x", "1 " + "9" * 30])
def test_a_point_without_its_damaged_track(tmp_path, track):
    (tmp_path / "points3D.txt").write_text(f"1 0.5 1.5 2.5 0 0 0 0 {track}\n")
    assert len(read_points(tmp_path).xyz) == 1


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("1 PINHOLE 32 24 30 30 16", "damaged: 3 parameters for camera model PINHOLE"),
        ("1 PINHOLE 32 24 30 30 16 12 0", "damaged: 5 parameters for camera model PINHOLE"),
        ("1 SIMPLE_PINHOLE 32 24 30 30 16 12", "4 parameters for camera model SIMPLE_PINHOLE"),
        ("1 FULL_OPENCV 32 24 30 30 16 12", "4 parameters for camera model FULL_OPENCV"),
        ("1 PINHOLE 32 0 30 30 16 12", "damaged: a camera has the size 32x0"),
        ("1 PINHOLE 32", "damaged: not a camera: line '1 PINHOLE 32'"),
        ("1 PINHOLE 32 24 a b c d", "damaged: not a camera: line '1 PINHOLE 32 24 a b c d'"),
        ("1 NEW_MODEL 32 24 30 30 16 12", "unknown camera model 'NEW_MODEL'"),
    ],
)
def test_lines_that_are_not_cameras(dataset_copy, camera, message):
    folder = dataset_copy("colmap-txt")
    (folder / "sparse/0/cameras.txt").write_text(camera + "\n")
    with pytest.raises(UserError, match=message):
        load_dataset(folder)


@pytest.mark.parametrize("block", [1, 2, 3, 4, 7, 100])
def test_words_of_observations_are_counted_in_blocks(tmp_path, monkeypatch, block):
    """A word may continue in the next block."""
    monkeypatch.setattr("snowsplat.data.colmap.text._CHARACTERS_PER_BLOCK", block)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    (tmp_path / "points3D.txt").write_text("")
    for observations, valid in (
        ("12 3.25 -1 400.5\t7  8", True),
        ("12.5 3 -1", True),
        ("12 3.25 -1 400", False),
        ("1 2", False),
        ("", True),
    ):
        (tmp_path / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 a.png\n{observations}\n")
        if valid:
            assert [image.name for image in read_model(tmp_path).images] == ["a.png"]
        else:
            with pytest.raises(UserError, match=r"line after image a\.png should hold"):
                read_model(tmp_path)


@pytest.mark.parametrize(
    ("norm", "distance", "valid"),
    [
        (0.51, 0.0, True),
        (1.99, 0.99e15, True),
        (0.49, 0.0, False),
        (2.01, 0.0, False),
        (1.0, 1.01e15, False),
    ],
)
def test_limits_of_poses(tmp_path, norm, distance, valid):
    camera = lens_of("SIMPLE_PINHOLE", 32, 24, (30.0, 16.0, 12.0))
    image = ColmapImage("a.png", 1, (0.6 * norm, 0.8 * norm, 0.0, 0.0, 0.0, 0.0, -distance))
    model = ColmapModel(tmp_path, False, {1: camera}, [image])
    if valid:
        assert float(posed_camera(model, image).cam_from_world[2, 3]) == -distance
    else:
        with pytest.raises(UserError, match=r"the pose of image a\.png is damaged"):
            posed_camera(model, image)


def test_an_image_with_an_unknown_camera(dataset_copy):
    folder = dataset_copy("colmap-bin")
    model = read_model(folder / "sparse/0")
    nothing = np.empty((0, 3))
    write_model(folder / "sparse/0", {5: model.cameras[1]}, model.images, nothing, nothing)
    with pytest.raises(UserError, match="camera 1, which the model does not contain"):
        load_dataset(folder)


def test_an_image_with_the_number_of_another_one_and_an_unknown_camera(dataset_copy, caplog):
    """The tracks of the points ask for the camera of a number."""
    folder = dataset_copy("colmap-txt")
    images = folder / "sparse/0/images.txt"
    lines = images.read_text().splitlines()
    first = next(line for line in lines if not line.startswith("#"))
    *pose, camera, _ = first.split()
    assert camera == "1"
    images.write_text("\n".join([*lines, " ".join([*pose, "77", "other.png"]), "", ""]))
    with caplog.at_level(logging.WARNING, "snowsplat"):
        dataset = load_dataset(folder)
    assert len(dataset.train) > 1


def test_numbers_of_the_camera_models_in_binary_files(tmp_path):
    """COLMAP's numbers, and how many parameters each model has."""
    models = {
        "SIMPLE_PINHOLE": (0, 3),
        "PINHOLE": (1, 4),
        "SIMPLE_RADIAL": (2, 4),
        "RADIAL": (3, 5),
        "OPENCV": (4, 8),
        "OPENCV_FISHEYE": (5, 8),
        "FULL_OPENCV": (6, 12),
        "FOV": (7, 5),
        "SIMPLE_RADIAL_FISHEYE": (8, 4),
        "RADIAL_FISHEYE": (9, 5),
        "THIN_PRISM_FISHEYE": (10, 12),
    }
    nothing = np.empty((0, 3))
    for name, (number, count) in models.items():
        params = tuple(float(i + 1) for i in range(count))
        camera = lens_of(name, 640, 480, params)
        write_model(tmp_path, {3: camera}, [ColmapImage("a", 3, POSE)], nothing, nothing)
        content = (tmp_path / "cameras.bin").read_bytes()
        expected = struct.pack(f"<QIiQQ{count}d", 1, 3, number, 640, 480, *params)
        assert content == expected
        assert read_model(tmp_path).cameras == {3: camera}


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_the_number_of_records_is_limited(tmp_path, monkeypatch, suffix):
    cameras = {i: lens_of("SIMPLE_PINHOLE", 32, 24, (30.0, 16.0, 12.0)) for i in range(2)}
    images = [ColmapImage(f"{i}.png", 0, POSE) for i in range(3)]
    nothing = np.empty((0, 3))
    write_model(tmp_path, cameras, images, nothing, nothing, text=suffix == "txt")
    monkeypatch.setattr(types, "_MAX_RECORDS", 3)
    assert len(read_model(tmp_path).images) == 3
    for limit, kind in ((2, "images"), (1, "cameras")):
        monkeypatch.setattr(types, "_MAX_RECORDS", limit)
        with pytest.raises(UserError, match=f"/{kind}.{suffix}: more than {limit} {kind}"):
            read_model(tmp_path)


def test_bytes_of_a_point(tmp_path):
    """Number, position, colour, reprojection error, and the track."""
    xyz, rgb = np.array([[0.5, -1.5, 2.5]]), np.array([[1, 2, 3]], np.uint8)
    write_model(tmp_path, {}, [], xyz, rgb, [[(7, 8), (9, 10)]])
    expected = struct.pack("<QQ3d3BdQ4I", 1, 1, 0.5, -1.5, 2.5, 1, 2, 3, 0.0, 2, 7, 8, 9, 10)
    assert (tmp_path / "points3D.bin").read_bytes() == expected


def test_of_two_images_of_one_name_the_first_is_used(dataset_copy, caplog):
    folder = dataset_copy("colmap-txt")
    path = folder / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("view_03.png", "view_02.png"))
    found = load_dataset(folder)
    assert len(found.train) + len(found.test) == 8
    assert "several images named view_02.png" in caplog.text
