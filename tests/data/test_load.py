"""`load_dataset`, independent of the format: sizes, smaller copies, splits, damaged images."""

import dataclasses
import logging
import shutil
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import data
from snowsplat.data import ImageLoader, Points, load_dataset, read_files
from snowsplat.data.dataset import safe_name
from snowsplat.data.frame.bounds import scene_bounds, scene_extent
from snowsplat.data.hold_out import held_out_names
from snowsplat.data.readers import read_poses
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import SettingError, UserError


def resize_folder(source, target, size):
    target.mkdir(exist_ok=True)
    for path in source.iterdir():
        with Image.open(path) as image:
            image.resize(size).save(target / path.name)


def test_public_names_can_be_imported():
    for name in data.__all__:
        assert getattr(data, name).__name__ == name


def test_names_of_views_are_relative_paths():
    assert safe_name("a\\b/./../c.png") == "a/b/c.png"
    assert safe_name("C:\\photos//1.png") == safe_name("/photos/1.png") == "photos/1.png"


def test_every_eighth_image_by_name_is_held_out(pristine):
    dataset = load_dataset(pristine["colmap-bin"])
    assert [view.name for view in dataset.test] == ["view_00.png", "view_08.png"]
    assert [view.name for view in dataset.train] == [f"view_0{i}.png" for i in range(1, 8)]
    assert len(load_dataset(pristine["colmap-bin"], hold_out=3).test) == 3
    between = load_dataset(pristine["colmap-bin"], hold_out=3, first_held_out=1)
    assert [view.name for view in between.test] == ["view_01.png", "view_04.png", "view_07.png"]
    (middle,) = load_dataset(pristine["colmap-bin"], first_held_out=20).test
    assert middle.name == "view_04.png"
    assert not held_out_names(read_poses(pristine["colmap-bin"]).images[:1], 8, 0, None)
    with pytest.raises(SettingError, match="-1 is not valid"):
        load_dataset(pristine["colmap-bin"], first_held_out=-1)
    everything = load_dataset(pristine["colmap-bin"], hold_out=None)
    assert (len(everything.train), len(everything.test)) == (9, 0)


def test_extent_is_computed_from_the_training_cameras(pristine):
    dataset = load_dataset(pristine["colmap-bin"])
    centres = torch.stack([view.camera.position for view in dataset.train])
    farthest = (centres - centres.mean(0)).norm(dim=1).max()
    assert dataset.extent == pytest.approx(1.1 * float(farthest))


def test_files_that_are_read_once_give_the_dataset_at_any_resolution(pristine, tmp_path):
    """The dataset is the same as if the files were read again.

    This also holds if the photos are smaller than their cameras.
    """
    half = write_toy_dataset(tmp_path / "half", "colmap-bin", 9, 66, 50)
    resize_folder(half / "images", half / "images", (33, 25))
    for root in (pristine["colmap-bin"], half):
        files = read_files(DatasetSettings(str(root), hold_out=8))
        files.dataset(-1)
        for width in (23, 30):
            once, again = files.dataset(width), load_dataset(root, resolution=width)
            assert [view.name for view in once.test] == [view.name for view in again.test]
            for a, b in zip(once.train, again.train, strict=True):
                assert a.image == b.image
                for name in ("width", "height", "fx", "fy", "cx", "cy"):
                    assert getattr(a.camera, name) == getattr(b.camera, name)
                assert a.camera.cam_from_world.equal(b.camera.cam_from_world)


def test_lists_of_test_images(pristine, tmp_path):
    names = ["view_02.png", "view_05"]
    dataset = load_dataset(pristine["colmap-txt"], test_list=names)
    assert [view.name for view in dataset.test] == ["view_02.png", "view_05.png"]
    for encoding in ("utf-8-sig", "utf-16"):  # as Windows writes
        text = "view_02.png\r\n\n view_05 \n"
        (tmp_path / "test.txt").write_text(text, encoding=encoding)
        again = load_dataset(pristine["colmap-txt"], test_list=tmp_path / "test.txt")
        assert [view.name for view in again.test] == ["view_02.png", "view_05.png"]
    with pytest.raises(UserError, match="'view_99' is not an image"):
        load_dataset(pristine["colmap-txt"], test_list=["view_99"])
    with pytest.raises(UserError, match="cannot be read"):
        load_dataset(pristine["colmap-txt"], test_list=tmp_path / "absent.txt")


def test_no_image_is_left_for_training(pristine):
    with pytest.raises(UserError, match="all 9 images are held out"):
        load_dataset(pristine["colmap-bin"], hold_out=1)


@pytest.mark.parametrize(
    ("resolution", "size"),
    [(None, (32, 24)), (-1, (32, 24)), (1, (32, 24)), (23, (23, 17)), (1600, (32, 24))],
)
def test_resolution_at_decode(pristine, resolution, size):
    view = load_dataset(pristine["colmap-bin"], resolution=resolution).train[0]
    full = load_dataset(pristine["colmap-bin"]).train[0]
    with ImageLoader([view]) as loader:
        assert loader.get(view).rgb.shape == (size[1], size[0], 3)
    assert (view.camera.width, view.camera.height) == size
    assert view.image.stored == 32 * 24
    assert view.camera.fx == pytest.approx(full.camera.fx * size[0] / 32)
    assert view.camera.cy == pytest.approx(full.camera.cy * size[1] / 24)


@pytest.mark.parametrize("resolution", [0, -2, 3, 8])
def test_invalid_resolutions(pristine, resolution):
    with pytest.raises(UserError, match=f"resolution: {resolution} (is not valid|makes images)"):
        load_dataset(pristine["colmap-bin"], resolution=resolution)


def test_the_smallest_side_of_a_smaller_image_is_16(pristine):
    small = load_dataset(pristine["colmap-bin"], resolution=21).train[0].camera
    assert (small.width, small.height) == (21, 16)
    for resolution, size in ((20, "20x15"), (2, "16x12"), (16, "16x12"), (8, "4x3")):
        with pytest.raises(UserError, match=f"{resolution} makes images of {size} pixels"):
            load_dataset(pristine["colmap-bin"], resolution=resolution)


@pytest.fixture(scope="module")
def large_source(tmp_path_factory):
    return write_toy_dataset(tmp_path_factory.mktemp("large"), "colmap-bin", 3, 75, 64)


@pytest.fixture
def large(large_source, tmp_path):
    """A dataset that a test may change; its images are large enough to divide."""
    return shutil.copytree(large_source, tmp_path / "large")


def test_intrinsics_are_scaled_to_the_rounded_size(large):
    view = load_dataset(large, resolution=2).train[0]
    full = load_dataset(large).train[0]
    assert (view.camera.width, view.camera.height) == (38, 32)
    assert view.camera.fx == pytest.approx(full.camera.fx * 38 / 75)
    assert view.camera.fy == pytest.approx(full.camera.fy / 2)
    assert "images" in view.image.path.parts
    quarter = load_dataset(large, resolution=4).train[0].camera
    assert (quarter.width, quarter.height) == (19, 16)


def test_folders_of_smaller_copies_are_used(large):
    resize_folder(large / "images", large / "images_2", (37, 32))
    view = load_dataset(large, resolution=2).train[0]
    assert view.image.path.parent.name == "images_2"
    assert (view.camera.width, view.camera.height) == (37, 32)
    # The folder can also be selected by name, and then be divided further.
    view = load_dataset(large, images="images_2").train[0]
    assert (view.camera.width, view.camera.height) == (37, 32)
    view = load_dataset(large, images="images_2", resolution=2).train[0]
    assert (view.camera.width, view.camera.height) == (18, 16)


@pytest.mark.parametrize("problem", ["is missing", "is not 1/2"])
def test_folders_of_smaller_copies_that_do_not_fit_are_not_used(large, caplog, problem):
    resize_folder(large / "images", large / "images_2", (75, 64) if "not" in problem else (37, 32))
    if problem == "is missing":
        (large / "images_2/view_01.png").unlink()
    with caplog.at_level(logging.WARNING):
        view = load_dataset(large, resolution=2).train[0]
    assert view.image.path.parent.name == "images"
    assert view.camera.width == 38
    assert problem in caplog.text


def test_images_that_are_all_smaller_by_the_same_integer_factor(large, caplog):
    """Some datasets are distributed without the large images that the poses belong to."""
    resize_folder(large / "images", large / "images", (38, 32))
    with caplog.at_level(logging.WARNING):
        view = load_dataset(large).train[0]
    assert (view.camera.width, view.camera.height) == (38, 32)
    assert "1/2 of the size of their cameras" in caplog.text


@pytest.mark.parametrize("size", [(74, 64), (64, 75), (150, 128), (50, 43), (38, 32)])
def test_one_image_of_another_size_is_left_out(large, size, caplog):
    path = large / "images/view_01.png"
    with Image.open(path) as image:
        resized = image.resize(size)
    resized.save(path)
    assert "view_01.png" not in {view.name for view in load_dataset(large, hold_out=None).train}
    assert f"1 of 3 photos are left out: view_01.png ({path}: is {size[0]}x{size[1]}" in caplog.text


def jpeg_with_orientation(path, pixels, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif, quality=100, subsampling=0)


def test_exif_orientation_is_applied_only_if_the_size_proves_it(dataset_copy):
    folder = dataset_copy("colmap-bin")
    path = folder / "images/view_01.png"
    pixels = np.zeros((24, 32, 3), np.uint8)
    pixels[:12] = 200  # the upper half, as stored
    path.unlink()
    jpeg_with_orientation(path.with_suffix(".jpg"), pixels, 3)
    path.with_suffix(".jpg").rename(path)
    view = next(v for v in load_dataset(folder).train if v.name == "view_01.png")
    with ImageLoader([view]) as loader:
        assert loader.get(view).rgb[0, 0, 0] > 150  # as stored, not upside down
    # As stored, the image is 24 wide and its left half is bright. Rotated clockwise, it fits the
    # camera and its upper half is bright.
    jpeg_with_orientation(path.with_suffix(".jpg"), pixels.transpose(1, 0, 2).copy(), 6)
    path.with_suffix(".jpg").rename(path)
    view = next(v for v in load_dataset(folder).train if v.name == "view_01.png")
    with ImageLoader([view]) as loader:
        image = loader.get(view).rgb
    assert image.shape == (24, 32, 3)
    assert image[:11].min() > 150
    assert image[13:].max() < 50


def test_a_mask_has_the_orientation_of_its_image(dataset_copy):
    folder = dataset_copy("colmap-bin")
    pixels = np.zeros((32, 24, 3), np.uint8)
    pixels[:, :12] = 255  # the left half, as stored; rotated clockwise, the upper half
    (folder / "masks").mkdir()
    for name in ("images/view_01.png", "masks/view_01.png"):
        jpeg_with_orientation(folder / "upright.jpg", pixels, 6)
        (folder / "upright.jpg").replace(folder / name)
    view = next(v for v in load_dataset(folder).train if v.name == "view_01.png")
    with ImageLoader([view]) as loader:
        mask = loader.get(view).mask
    assert mask[:11].all()
    assert not mask[13:].any()


def test_masks_beside_the_images(dataset_copy):
    folder = dataset_copy("colmap-bin")
    (folder / "masks").mkdir()
    Image.new("L", (32, 24)).save(folder / "masks/view_01.png.png")
    Image.new("L", (32, 24), 255).save(folder / "masks/view_02.png")
    views = load_dataset(folder).train
    assert [view.mask is not None for view in views[:3]] == [True, True, False]
    with ImageLoader(views) as loader:
        assert not loader.get(views[0]).mask.any()
        assert loader.get(views[1], 2).mask.all()


@pytest.mark.parametrize("name", ["depths", "depth", "depth_maps", "mono_depth", "Depth_npy"])
def test_depth_maps_beside_the_images(dataset_copy, name):
    folder = dataset_copy("colmap-bin")
    (folder / name).mkdir()
    for file in ("view_01.png", "view_02.png.npy", "view_03.txt", "view_04_aligned.npy"):
        (folder / name / file).touch()
    views = load_dataset(folder, hold_out=None).train
    names = {view.name: view.depth and view.depth.name for view in views}
    assert {name: depth for name, depth in names.items() if depth} == {
        "view_01.png": "view_01.png",
        "view_02.png": "view_02.png.npy",
        "view_04.png": "view_04_aligned.npy",
    }


def test_maps_of_no_photo_are_named(dataset_copy, caplog):
    folder = dataset_copy("colmap-bin")
    (folder / "normals").mkdir()
    (folder / "normals" / "other.png").touch()
    load_dataset(folder)
    assert "normals: none of its files has the name of a photo; not used" in caplog.text


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n"])
def test_files_that_are_no_images_are_left_out_if_they_are_few(dataset_copy, content, caplog):
    folder = dataset_copy("colmap-bin")
    (folder / "images/view_04.png").write_bytes(content)
    assert len(load_dataset(folder, hold_out=None).train) == 8
    assert "1 of 9 photos are left out: view_04.png (" in caplog.text
    for number in range(5, 9):
        (folder / f"images/view_{number:02}.png").write_bytes(content)
    with pytest.raises(UserError, match="view_04.png: cannot be decoded"):
        load_dataset(folder)


def test_paths_that_are_not_datasets(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        load_dataset(tmp_path / "absent")
    with pytest.raises(UserError, match="no camera poses here.*snowsplat sfm"):
        load_dataset(tmp_path)
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="not a dataset"):
        load_dataset(tmp_path / "file")


def test_the_extent_of_cameras_in_one_place_is_one(pristine):
    cameras = [view.camera for view in load_dataset(pristine["colmap-bin"]).train]
    assert scene_extent(cameras[:1]) == 1.0
    # The extent is 1.1 times the distance from the middle, however small this distance is.
    pose = cameras[0].cam_from_world.clone()
    pose[0, 3] += 0.5
    pair = [cameras[0], dataclasses.replace(cameras[0], cam_from_world=pose)]
    assert scene_extent(pair) == pytest.approx(1.1 * 0.25)


def test_bounds_of_a_dataset_are_those_of_its_points_or_training_cameras(pristine):
    dataset = load_dataset(pristine["colmap-bin"])
    cameras = [view.camera for view in dataset.train]
    alone = dataclasses.replace(dataset, points=None)
    assert torch.equal(alone.bounds, scene_bounds(cameras))
    only_test = dataclasses.replace(alone, train=[], test=dataset.train)
    assert torch.equal(only_test.bounds, scene_bounds(cameras))
    xyz = torch.rand(200, 3)
    dense = dataclasses.replace(dataset, points=Points(xyz, torch.zeros(200, 3)))
    assert torch.equal(dense.bounds, scene_bounds(cameras, xyz))


def test_points_move_together():
    points = Points(torch.ones(2, 3), torch.full((2, 3), 7, dtype=torch.uint8))
    moved = points.to(torch.device("meta"))
    assert moved.xyz.device.type == moved.rgb.device.type == "meta"
    assert moved.rgb.dtype == torch.uint8
    assert len(points.to(torch.device("cpu"))) == 2


def test_a_zip_file_is_no_dataset(tmp_path):
    """It begins like the cameras.npz of IDR."""
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as packed:
        packed.writestr("photos/0.jpg", b"a photo")
    with pytest.raises(UserError, match=r"photos.zip: is a zip file; unpack it"):
        load_dataset(tmp_path / "photos.zip")
