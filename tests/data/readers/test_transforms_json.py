"""The variants of transforms.json: intrinsics, axes, names, splits, points, damaged files."""

import json
import logging
import math

import numpy as np
import pillow_heif
import pytest
import torch
from PIL import Image

from snowsplat.data import ImageLoader, load_dataset
from snowsplat.data.points_ply import write_points
from snowsplat.util.errors import UserError

F64 = torch.float64
# In OpenGL's axes: a camera at (1, 2, 3) that looks along −z of the world; up is the world's +y.
UPRIGHT = [[1.0, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


@pytest.fixture
def scene(tmp_path):
    """A function that writes a transforms.json with these frames, and its images, 40×30."""

    def write(common, frames, file="transforms.json", existing=None):
        for number, frame in enumerate(frames):
            frame.setdefault("file_path", f"images/{number}.png")
            frame.setdefault("transform_matrix", UPRIGHT)
            if existing is None or number in existing:
                path = tmp_path / frame["file_path"]
                path = path if path.suffix else path.with_suffix(".png")
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.new("RGB", (40, 30), (number, 0, 0)).save(path)
        (tmp_path / file).write_text(json.dumps({**common, "frames": frames}))
        return tmp_path

    return write


def camera_of(common, frame, scene):
    return load_dataset(scene(common, [frame]), hold_out=None).train[0].camera


def test_axes_are_converted(scene):
    camera = camera_of({"fl_x": 50}, {}, scene)
    assert camera.position.tolist() == [1, 2, 3]
    ahead = torch.tensor([[1.0, 2, 2], [1.1, 2.2, 2]], dtype=F64)
    pixels, depth = camera.project(ahead)
    assert torch.allclose(depth, torch.ones(2, dtype=F64))
    # World +x is to the right in the image, and world +y is up, towards row 0.
    expected = torch.tensor([[20.0, 15], [20 + 50 * 0.1, 15 - 50 * 0.2]], dtype=F64)
    assert torch.allclose(pixels, expected)


FIELD = 2 * math.atan(0.4)  # 40 pixels at a focal length of 50


@pytest.mark.parametrize(
    ("common", "expected"),
    [
        ({"camera_angle_x": FIELD}, (50, 50, 20, 15)),
        ({"K": [[50, 0, 20], [0, 50, 15], [0, 0, 1]], "w": 40, "h": 30}, (50, 50, 20, 15)),
        ({"camera_angle_x": FIELD, "camera_angle_y": 2 * math.atan(0.3)}, (50, 50, 20, 15)),
        ({"x_fov": math.degrees(FIELD)}, (50, 50, 20, 15)),
        ({"fl_x": 0.5, "fl_y": 0.75}, (0.5, 0.75, 20, 15)),
        # A width without a height has no effect.
        ({"fl_x": 50.0, "w": 80}, (50, 50, 20, 15)),
        ({"fl_x": 50.0, "h": 60}, (50, 50, 20, 15)),
        ({"fl_x": 50.0, "fl_y": 60.0, "cx": 19.0, "cy": 14.5}, (50, 60, 19, 14.5)),
        ({"fl_x": 50, "fl_y": 60, "cx": 19, "cy": 14.5, "w": 40, "h": 30.0}, (50, 60, 19, 14.5)),
        ({"fl_y": 60.0, "k1": 0.0, "camera_model": "OPENCV"}, (60, 60, 20, 15)),
        # A folder of images at half the size of the intrinsics.
        ({"fl_x": 100.0, "cx": 41.0, "w": 80, "h": 60}, (50, 50, 20.5, 15)),
    ],
)
def test_all_variants_of_intrinsics(scene, common, expected):
    camera = camera_of(common, {}, scene)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(expected)
    assert (camera.width, camera.height) == (40, 30)


def test_a_frame_overrides_the_file(scene):
    folder = scene({"fl_x": 50.0, "cx": 3.0}, [{"fl_x": 70.0}, {}])
    assert [v.camera.fx for v in load_dataset(folder, hold_out=None).train] == [70.0, 50.0]


#: What is wrong with a frame, and what the error says. The other frame has a focal length.
BROKEN = [
    ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO.*snowsplat sfm"),
    ({"fl_x": None}, "no focal length"),
    ({"fl_x": "wide"}, "fl_x should be a number"),
    ({"fl_x": 0}, "focal lengths 0"),
    ({"fl_x": float("nan")}, "fl_x should be a number"),
    ({"camera_angle_x": 4, "fl_x": None}, "field of view"),
    ({"h": 0, "w": 4}, "h should be|size"),
    ({"w": "wide"}, "w should be a number"),
    ({"h": "high"}, "h should be a number"),
    ({"cx": "middle"}, "cx should be a number"),
    ({"cy": "middle"}, "cy should be a number"),
    ({"k1": "strong"}, "k1 should be a number"),
    ({"mask_path": "missing.png"}, "missing.png"),
    ({"mask_path": "../outside.png"}, "outside.png"),
    ({"transform_matrix": "none"}, "transform_matrix: should be 16 numbers"),
    ({"transform_matrix": [1]}, "transform_matrix: should be"),
    ({"transform_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "should be 12 numbers"),
    ({"transform_matrix": [[float("inf")] * 4] * 4}, "should be 16 numbers"),
    ({"transform_matrix": [[0, 0, 0, 1]] * 4}, "not a rotation"),
    ({"transform_matrix": [[1, 0.2, 0, 0], *np.eye(4)[1:].tolist()]}, "not a rotation"),
    ({"transform_matrix": np.diag([-1, 1, 1, 1]).tolist()}, "mirrors"),
    ({"transform_matrix": np.transpose(UPRIGHT).tolist()}, "transform_matrix is transposed"),
]


@pytest.mark.parametrize(("frame", "message"), BROKEN)
def test_errors_name_the_file_the_frame_and_the_fault(scene, frame, message):
    folder = scene({}, [{"fl_x": 50}, {"fl_x": 50} | frame])
    with pytest.raises(UserError, match=message) as error:
        load_dataset(folder)
    assert str(error.value).startswith(f"{folder}/transforms.json: frame 1: ")


def test_a_camera_of_another_size_than_its_image(scene):
    with pytest.raises(UserError, match="is 40x30, but its camera is 64x50"):
        camera_of({"fl_x": 50, "w": 64, "h": 50}, {}, scene)


def test_a_scaled_matrix_keeps_its_directions(scene):
    matrix = np.array(UPRIGHT)
    matrix[:3, :3] *= 0.01
    camera = camera_of({"fl_x": 50}, {"transform_matrix": matrix.tolist()}, scene)
    assert camera.position.tolist() == pytest.approx([1, 2, 3])
    assert torch.allclose(camera.cam_from_world[:, :3].abs(), torch.eye(3, dtype=F64))


def test_missing_frames_are_skipped_and_counted(scene, caplog):
    folder = scene({"fl_x": 50}, [{}, {}, {}], existing=[1])
    with caplog.at_level(logging.WARNING):
        dataset = load_dataset(folder, hold_out=None)
    assert [view.name for view in dataset.train] == ["images/1.png"]
    assert "2 of 3 images are missing (the first is 'images/0.png')" in caplog.text
    (folder / "images/1.png").unlink()
    with pytest.raises(UserError, match=r"all of its 3 images are missing \(the first is 'im"):
        load_dataset(folder)


@pytest.mark.parametrize("spelling", ["./a/b", "a/b.png", "a\\b.png", "./a//b", "{root}/a/b"])
def test_file_names(scene, tmp_path, spelling):
    folder = scene({"fl_x": 50}, [{"file_path": "a/b"}])
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["file_path"] = spelling.format(root=tmp_path)
    (folder / "transforms.json").write_text(json.dumps(content))
    view = load_dataset(folder, hold_out=None).train[0]
    assert view.image.path.samefile(folder / "a/b.png")
    assert view.name.endswith("a/b.png")
    assert not view.name.startswith(("/", "."))
    assert load_dataset(folder / "transforms.json", hold_out=None).train[0].name == view.name


def test_heic_photos(scene):
    pillow_heif.register_heif_opener()
    assert camera_of({"fl_x": 50}, {"file_path": "a.heic"}, scene).width == 40


def test_blender_splits(dataset_copy):
    folder = dataset_copy("blender")
    dataset = load_dataset(folder)
    assert [view.name for view in dataset.test] == ["test/r_0.png", "test/r_8.png"]
    assert len(dataset.train) == 7
    assert dataset.points is None
    # hold_out=None also trains on the test split; test_list replaces the split.
    assert len(load_dataset(folder, hold_out=None).train) == 9
    assert [view.name for view in load_dataset(folder, test_list=["r_3"]).test] == ["train/r_3.png"]
    # Without a test split, hold_out applies.
    (folder / "transforms_test.json").unlink()
    assert [v.name for v in load_dataset(folder, hold_out=4).test] == [
        "train/r_1.png",
        "train/r_5.png",
    ]


def test_blender_validation_split_replaces_a_missing_test_split(dataset_copy):
    folder = dataset_copy("blender")
    (folder / "transforms_test.json").rename(folder / "transforms_val.json")
    assert len(load_dataset(folder).test) == 2


def test_alpha_is_used(dataset_copy):
    view = load_dataset(dataset_copy("blender")).train[0]
    with ImageLoader([view]) as loader:
        image = loader.get(view)
    assert image.alpha is not None
    assert image.alpha.min() == 0
    assert image.alpha.max() == 255
    corner = image.over(torch.tensor([0.2, 0.4, 1.0]))[0, 0]
    assert torch.allclose(corner, torch.tensor([0.2, 0.4, 1.0]))


def test_splits_of_nerfstudio(scene):
    """An image in several lists is used for training."""
    names = [f"images/{i}.png" for i in range(4)]
    lists = {"train_filenames": names[:3], "test_filenames": names[2:], "val_filenames": names[:1]}
    folder = scene({"fl_x": 50, **lists}, [{} for _ in names])
    assert [view.name for view in load_dataset(folder).test] == names[3:]


def test_points_of_ply_file_path(scene, tmp_path):
    xyz = np.array([[1.0, 2, i] for i in range(30)] + [[np.nan, 0, 0]], np.float32)
    write_points(tmp_path / "cloud.ply", xyz, np.array([[1, 2, 3]] * 31, np.uint8))
    points = load_dataset(scene({"fl_x": 50, "ply_file_path": "cloud.ply"}, [{}, {}])).points
    assert points.xyz.tolist() == xyz[:30].tolist()
    assert points.rgb.tolist() == [[1, 2, 3]] * 30


def test_a_missing_ply_file_is_reported(scene, caplog):
    with caplog.at_level(logging.WARNING):
        dataset = load_dataset(scene({"fl_x": 50, "ply_file_path": "cloud.ply"}, [{}, {}]))
    assert dataset.points is None
    assert "cloud.ply: the point cloud (ply_file_path) is missing" in caplog.text


def test_a_ply_file_outside_of_the_folder_is_refused(scene):
    folder = scene({"fl_x": 50, "ply_file_path": "../cloud.ply"}, [{}, {}])
    with pytest.raises(UserError) as error:
        load_dataset(folder)
    assert str(error.value).startswith(f"{folder}: ply_file_path: '../cloud.ply' is not in")


def test_points_of_the_colmap_model_of_nerfstudio(scene, dataset_copy, tmp_path):
    source = load_dataset(dataset_copy("colmap-bin")).points
    transform = [[0.0, 1, 0, 5], [1, 0, 0, 6], [0, 0, -1, 7]]
    folder = scene({"fl_x": 50, "applied_transform": transform}, [{}, {}])
    (folder / "colmap").mkdir()
    (tmp_path / "colmap-bin/sparse").rename(folder / "colmap/sparse")
    points = load_dataset(folder).points
    matrix = torch.tensor(transform)
    assert torch.allclose(points.xyz, source.xyz @ matrix[:, :3].T + matrix[:, 3])


def test_masks(scene, tmp_path):
    left = Image.new("L", (40, 30))
    left.paste(255, (0, 0, 20, 30))
    left.save(tmp_path / "left.png")
    folder = scene({"fl_x": 50}, [{"mask_path": "left.png"}, {}])
    views = load_dataset(folder, hold_out=None).train
    with ImageLoader(views) as loader:
        mask = loader.get(views[0]).mask
        assert mask[:, :20].all()
        assert not mask[:, 20:].any()
        assert loader.get(views[1]).mask is None
    Image.new("L", (10, 30)).save(tmp_path / "left.png")
    with pytest.raises(UserError, match="mask is 10x30, but its image is 40x30"):
        load_dataset(folder)


@pytest.mark.parametrize("prefix", ["/home/me/scan/", "C:\\scan\\", "../"])
def test_paths_of_another_computer(scene, prefix):
    masks, depths = f"{prefix}m/1.png", f"{prefix}d/1.png"
    folder = scene({"fl_x": 50}, [{"mask_path": masks, "depth_file_path": depths}])
    for name in ("m", "d"):
        (folder / name).mkdir()
        Image.new("L", (40, 30), 255).save(folder / name / "1.png")
    (view,) = load_dataset(folder, hold_out=None).train
    assert view.mask.path == folder / "m/1.png"
    assert view.depth == folder / "d/1.png"


def test_depth_maps(scene, tmp_path):
    """Of nerfstudio; missing ones and those outside of the folder are ignored."""
    (tmp_path / "0.npy").touch()
    paths = ["0.npy", "absent.npy", "../0.npy", 3]
    folder = scene({"fl_x": 50}, [{"depth_file_path": path} for path in paths])
    views = load_dataset(folder, hold_out=None).train
    assert [view.depth for view in views] == [tmp_path / "0.npy", None, None, None]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a complete JSON file"),
        ("[" * 100_000, "not a complete JSON file"),
        ("[1]", "no list of frames"),
        ('{"frames": 3}', "no list of frames"),
        ('{"frames": []}', "transforms.json: it has no frames; check where the images are$"),
        ('{"frames": [{}]}', "frame 0: no file_path"),
        ('{"frames": [4]}', "frame 0: no file_path"),
    ],
)
def test_files_of_another_kind(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(UserError, match=message):
        load_dataset(tmp_path)


def test_renders_in_a_format_that_is_not_read_are_named(scene, tmp_path):
    folder = scene({"fl_x": 50}, [{"file_path": "r_0"}, {"file_path": "r_1"}], existing=())
    (tmp_path / "r_0.exr").touch()
    with pytest.raises(UserError, match=r"'r_0\.exr' is not read; convert them to PNG"):
        load_dataset(folder)


def test_the_same_image_twice(scene, caplog):
    """Is ignored; with another pose, only the first is used, and the other one is named."""
    twice = [{"file_path": "a.png"}, {"file_path": "./a.png"}, {}]
    assert len(load_dataset(scene({"fl_x": 50}, twice), hold_out=None).train) == 2
    assert "left out" not in caplog.text
    twice[1]["transform_matrix"] = [*UPRIGHT[:2], [0, 0, 1, 4], UPRIGHT[3]]
    dataset = load_dataset(scene({"fl_x": 50}, twice), hold_out=None)
    assert [float(view.camera.position[2]) for view in dataset.train] == [3, 3]
    assert "1 of 3 photos are left out: ./a.png" in caplog.text
    assert "also belongs to another frame" in caplog.text


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(("deviation", "valid"), [(0.008, True), (0.03, False)])
def test_matrices_may_deviate_from_a_rotation_by_one_percent(scene, scale, deviation, valid):
    matrix = np.array(UPRIGHT)
    matrix[0, 1] = 2 * deviation  # the nearest rotation is half of it away
    matrix[:3, :3] *= scale
    frame = {"transform_matrix": matrix.tolist()}
    if valid:
        rotation = camera_of({"fl_x": 50}, frame, scene).cam_from_world[:, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=F64))
    else:
        with pytest.raises(UserError, match="not a rotation"):
            camera_of({"fl_x": 50}, frame, scene)


def test_a_folder_of_smaller_copies_takes_the_place_of_images(scene):
    folder = scene({"fl_x": 50}, [{}, {}])
    (folder / "images").rename(folder / "photos")
    dataset = load_dataset(folder, images="photos", hold_out=None)
    assert [view.image.path.parent.name for view in dataset.train] == ["photos", "photos"]
    assert len({view.image.path for view in dataset.train}) == 2


@pytest.mark.parametrize("upper", [False, True])
def test_images_without_a_suffix_are_found(tmp_path, upper):
    suffixes = ["png", "jpg", "jpeg", "webp", "tif", "tiff", "bmp", "ppm"]
    frames = [{"file_path": f"of_{suffix}", "transform_matrix": UPRIGHT} for suffix in suffixes]
    for suffix in suffixes:
        name = f"of_{suffix}.{suffix.upper() if upper else suffix}"
        Image.new("RGB", (4, 3)).save(tmp_path / name)
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 5, "frames": frames}))
    dataset = load_dataset(tmp_path, hold_out=None)
    assert [view.image.path.suffix[1:].lower() for view in dataset.train] == sorted(suffixes)


@pytest.mark.parametrize(("focal", "warns"), [(50, False), (51, False), (35.7, True)])
def test_a_contradictory_angle(scene, caplog, focal, warns):
    common = {"fl_x": focal, "w": 40, "h": 30, "camera_angle_x": FIELD}
    with caplog.at_level(logging.WARNING):
        camera = camera_of(common, {}, scene)
    assert camera.fx == focal
    assert ("camera_angle_x (43.6028°) is a focal length of 50 pixels" in caplog.text) == warns
