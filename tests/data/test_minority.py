"""A few broken photos, frames or folders are named and left out; the rest of a dataset is used."""

import json
import os

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import load_dataset
from snowsplat.data.colmap.model import read_model, write_model
from snowsplat.data.dataset import Points
from snowsplat.data.files.photo_files import photos_below
from snowsplat.data.load import _are_placeholder
from snowsplat.data.photos.decode import read_header
from snowsplat.data.points_ply import write_points
from snowsplat.util.errors import UserError


def _break_transforms(folder, count):
    path = folder / "transforms_train.json"
    scene = json.loads(path.read_text())
    for frame in scene["frames"][:count]:
        frame["transform_matrix"][0][3] = float("nan")
    path.write_text(json.dumps(scene))


def _break_frames(folder, count):
    path = folder / "transforms_train.json"
    scene = json.loads(path.read_text())
    scene["frames"][:count] = [{"file_path": None}] * count
    path.write_text(json.dumps(scene))


def _break_colmap(camera=None, pose=None):
    def change(folder, count):
        model = read_model(folder / "sparse/0")
        images = list(model.images)
        for i in range(count):
            images[i] = type(images[i])(
                images[i].name,
                images[i].camera_id if camera is None else camera,
                images[i].pose if pose is None else pose,
            )
        nothing = np.empty((0, 3))
        write_model(folder / "sparse/0", model.cameras, images, nothing, nothing, text=model.text)

    return change


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("blender", _break_transforms),
        ("blender", _break_frames),
        ("colmap-bin", _break_colmap(camera=7)),
        ("colmap-txt", _break_colmap(pose=(0.0,) * 7)),
        ("colmap-bin", _break_colmap(pose=(float("nan"),) * 7)),
    ],
)
def test_a_minority_of_broken_frames_is_left_out(dataset_copy, caplog, kind, change):
    folder = dataset_copy(kind)
    every = len(load_dataset(folder, hold_out=None).train)
    change(folder, 2)
    assert len(load_dataset(folder, hold_out=None).train) == every - 2
    assert f"2 of {every} photos are left out" in caplog.text
    change(folder, every - 3)
    with pytest.raises(UserError):
        load_dataset(folder)


def test_a_folder_that_cannot_be_read_is_left_out(tmp_path, monkeypatch, caplog):
    """As lost+found at the top of a disk."""
    for name in ("a.png", "lost+found/b.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    scandir = os.scandir

    def refusing(path):
        if str(path).endswith("lost+found"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    assert photos_below(tmp_path) == ["a.png"]
    assert "lost+found: left out: Permission denied" in caplog.text


@pytest.mark.parametrize(("places", "count"), [(1, 1), (3, 3), (1, 500), (29, 5000)])
def test_placeholder_points_count_as_none(dataset_copy, caplog, places, count):
    """Other trainers insist on points, so people write some."""
    folder = dataset_copy("colmap-bin")
    model = read_model(folder / "sparse/0")
    xyz = np.zeros((count, 3))
    xyz[:, 0] = np.arange(count) % places
    rgb = np.zeros((count, 3), np.uint8)
    write_model(folder / "sparse/0", model.cameras, model.images, xyz, rgb)
    assert load_dataset(folder).points is None
    assert "fewer than 30 places: as if there were none" in caplog.text
    grid = torch.arange(30.0)[:, None].expand(30, 3)
    assert not _are_placeholder(Points(grid, torch.zeros(30, 3, dtype=torch.uint8)))


@pytest.mark.parametrize(("factor", "away", "used"), [(2, 0, 180), (1, 0, 60), (2, 1e3, 60)])
def test_a_denser_cloud_beside_a_model_is_used_if_the_cameras_see_it(
    dataset_copy, caplog, factor, away, used
):
    folder = dataset_copy("colmap-bin")
    own = load_dataset(folder).points
    xyz = np.repeat(own.xyz.numpy(), factor, 0) + away
    write_points(folder / "sparse/0/points3D.ply", xyz, np.repeat(own.rgb.numpy(), factor, 0))
    assert len(load_dataset(folder).points) == used
    assert ("its 120 points are used, too" in caplog.text) == (used == 180)
    assert ("not where the cameras look; not used" in caplog.text) == (away > 0)


def test_points_without_an_error(dataset_copy):
    folder = dataset_copy("colmap-txt")
    whole = load_dataset(folder).points
    path = folder / "sparse/0/points3D.txt"
    lines = [line.split() for line in path.read_text().splitlines() if line[:1] != "#"]
    path.write_text("".join(" ".join(line[:7]) + "\n" for line in lines))
    assert torch.equal(load_dataset(folder).points.xyz, whole.xyz)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_a_photo_whose_data_end_early_is_left_out(dataset_copy, caplog, suffix):
    """A copy that was interrupted is seen when the dataset is read, not while it is trained."""
    folder = dataset_copy("colmap-bin")
    every = len(load_dataset(folder, hold_out=None).train)
    for path in (folder / "images").iterdir():
        Image.open(path).convert("RGB").save(path.with_suffix(f".{suffix}"))
        if path.suffix != f".{suffix}":
            path.unlink()
    cut = sorted((folder / "images").iterdir())[1]
    cut.write_bytes(cut.read_bytes()[:-40])
    assert len(load_dataset(folder, hold_out=None).train) == every - 1
    assert f"1 of {every} photos are left out: {cut.stem}" in caplog.text


def test_bytes_after_a_photo_are_no_damage(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (30, 20), (9, 200, 30)).save(path)
    with open(path, "ab") as file:
        file.write(bytes(9000))
    assert read_header(path).width == 30
