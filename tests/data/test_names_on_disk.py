"""Datasets whose files have other names, or are at other places, than the poses say."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from snowsplat.data import load_dataset
from snowsplat.data.colmap.model import read_model, write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.util.errors import UserError


def views_of(folder):
    return load_dataset(folder, hold_out=None).train


def rename_images(folder, rename):
    """Change the names of the images of a dataset, not their files."""
    model = read_model(folder / "sparse/0")
    images = [
        ColmapImage(rename(image.name), image.camera_id, image.pose) for image in model.images
    ]
    nothing = np.empty((0, 3))
    write_model(folder / "sparse/0", model.cameras, images, nothing, nothing)


@pytest.mark.parametrize(
    "rename",
    [
        str.upper,
        lambda name: name.replace(".png", ".jpg"),
        lambda name: f"front/{name}",
        lambda name: f"/home/me/scan/images/{name}",
        lambda name: f"..\\images\\{name}",
    ],
)
def test_names_of_another_program_or_computer(dataset_copy, caplog, rename):
    folder = dataset_copy("colmap-bin")
    expected = [view.name for view in views_of(folder)]
    rename_images(folder, rename)
    assert [view.name for view in views_of(folder)] == expected
    assert "9 images are found by other names" in caplog.text


def test_names_in_another_encoding(dataset_copy):
    folder = dataset_copy("colmap-bin")
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(f"花园{path.name}"))
    rename_images(folder, lambda n: f"花园{n}".encode("gbk").decode("utf-8", "surrogateescape"))
    assert views_of(folder)[0].name == "花园view_00.png"


def test_a_photo_that_was_put_aside_stays_aside(dataset_copy):
    folder = dataset_copy("colmap-bin")
    (folder / "images/rejected").mkdir()
    (folder / "images/view_03.png").rename(folder / "images/rejected/view_03.png")
    assert len(views_of(folder)) == 8


def test_names_that_could_be_mixed_up_are_not_found(dataset_copy, caplog):
    folder = dataset_copy("colmap-bin")
    names = iter(
        ["left/view_00.png", "right/view_00.png"] + [f"left/view_0{i}.png" for i in range(2, 9)]
    )
    rename_images(folder, lambda _: next(names))
    with pytest.raises(
        UserError, match="has none of the 9 images .*it has 9 others, e.g. 'view_00"
    ):
        load_dataset(folder)
    assert "several" in caplog.text


@pytest.mark.parametrize(
    ("model", "images"),
    [
        ("dense/0/sparse", "dense/0/images"),
        ("sfm", "images"),
        ("sparse/0", "photos"),
        ("sparse/0", ""),
    ],
)
def test_other_places_of_model_and_images(dataset_copy, tmp_path, model, images):
    source = dataset_copy("colmap-bin")
    folder = tmp_path / "moved"
    shutil.copytree(source / "sparse/0", folder / model)
    shutil.copytree(source / "images", folder / images, dirs_exist_ok=True)
    assert len(views_of(folder)) == 9


def test_a_folder_of_datasets_and_a_part_of_one(dataset_copy, tmp_path):
    shutil.copytree(dataset_copy("colmap-bin"), tmp_path / "all/one")
    shutil.copytree(tmp_path / "all/one", tmp_path / "all/two")
    with pytest.raises(UserError, match="has several datasets \\('one', 'two', …\\); use one"):
        load_dataset(tmp_path / "all")
    for part in ("images", "sparse", "sparse/0"):
        with pytest.raises(UserError, match="a part of a dataset; use the whole: .*one"):
            load_dataset(tmp_path / "all/one" / part)


@pytest.mark.parametrize(
    "prefix", ["/home/me/scan/images/", "C:\\Users\\me\\scan\\images\\", "frames/"]
)
def test_paths_of_transforms_json(dataset_copy, prefix):
    folder = dataset_copy("blender")
    scene = json.loads((folder / "transforms_train.json").read_text())
    (folder / "images").mkdir()
    for number, frame in enumerate(scene["frames"]):
        shutil.copy(folder / f"{frame['file_path']}.png", folder / f"images/{number}.png")
        frame["file_path"] = f"{prefix}{number}.jpg"
    for name in ("train", "test"):
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / f"transforms_{name}.json").unlink(missing_ok=True)
    (folder / "transforms.json").write_text(json.dumps(scene))
    names = {view.name for view in views_of(folder)}
    assert names == {f"images/{i}.png" for i in range(len(scene["frames"]))}


def test_a_test_file_that_is_a_copy_of_the_training_file(dataset_copy, caplog):
    folder = dataset_copy("blender")
    shutil.copy(folder / "transforms_train.json", folder / "transforms_test.json")
    dataset = load_dataset(folder)
    assert dataset.train
    assert dataset.test
    assert "so this is no split" in caplog.text


def test_images_in_both_files_are_held_out(dataset_copy, caplog):
    folder = dataset_copy("blender")
    scene = json.loads((folder / "transforms_train.json").read_text())
    scene["frames"] = scene["frames"][:2]
    (folder / "transforms_test.json").write_text(json.dumps(scene))
    assert len(load_dataset(folder).test) == 2
    assert "2 images are in both" in caplog.text


@pytest.mark.parametrize("name", ["a b.png", "2 (1).png", "7"])
def test_a_text_model_without_lines_of_observations(dataset_copy, name):
    folder = dataset_copy("colmap-txt")
    (folder / "images/view_01.png").rename(folder / "images" / name)
    path = folder / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    path.write_text("\r\n".join(lines).replace("view_01.png", name))
    assert name in {view.name for view in views_of(folder)}


def test_held_out_images_are_in_the_order_of_their_numbers(dataset_copy):
    folder = dataset_copy("colmap-bin")
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(f"frame{int(path.stem[-2:]) + 5}.png"))
    rename_images(folder, lambda name: f"frame{int(name[5:7]) + 5}.png")
    held_out = [view.name for view in load_dataset(folder, hold_out=4).test]
    assert sorted(held_out) == ["frame13.png", "frame5.png", "frame9.png"]


def test_masks_of_other_size_and_masks_of_some_photos(dataset_copy, caplog):
    folder = dataset_copy("colmap-bin")
    (folder / "masks").mkdir()
    Image.new("L", (16, 12), 255).save(folder / "masks/view_01.png")
    Image.new("L", (64, 48), 255).save(folder / "masks/view_02_mask.png")
    Image.new("L", (64, 48), 255).save(folder / "masks/view_77.png")
    views = views_of(folder)
    assert [view.mask is not None for view in views[:4]] == [False, True, True, False]
    assert "1 masks are not used, because no photo has the name of" in caplog.text
    Image.new("L", (16, 13), 255).save(folder / "masks/view_03.png")
    views_of(folder)  # a rounded size
    Image.new("L", (12, 16), 255).save(folder / "masks/view_03.png")
    assert len(views_of(folder)) == len(views) - 1
    assert "the mask is 12x16, but its image is 32x24" in caplog.text
