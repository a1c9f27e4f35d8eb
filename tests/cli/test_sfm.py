"""`snowsplat sfm`: the output folder, repeated stages, the state after failures."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from snowsplat.cli.main import main
from snowsplat.data import load_dataset
from snowsplat.data.frame.placement import read_placement
from snowsplat.sfm.gps import location_of

from ..sfm.colmap import scenes
from ..sfm.pictures import exif

STAGES = ("photos", "poses", "images", "report")
QUICK = ("--quality", "draft", "--threads", "1")

pytestmark = pytest.mark.sfm


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """6 photos, 256×192; read-only for the tests."""
    return scenes.write_photos(tmp_path_factory.mktemp("dataset") / "photos", 6)


@pytest.fixture(scope="module")
def garden(photos, tmp_path_factory) -> Path:
    """Their dataset, with smaller copies; read-only for the tests."""
    out = tmp_path_factory.mktemp("made") / "garden"
    assert main(["sfm", str(photos), "-o", str(out), *QUICK, "--resize"]) == 0
    return out


def times(folder: Path) -> dict[str, int]:
    """Modification time of each file except the record."""
    found = (p for p in folder.rglob("*") if p.is_file() and p.name != "sfm.json")
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in found}


def test_layout_is_that_of_convert_py(garden, photos):
    names = {path.name for path in photos.iterdir()}
    placed = {path.name: Image.open(path).size for path in (garden / "images").iterdir()}
    assert placed.keys() <= names
    for divisor in (2, 4, 8):
        copies = {p.name: Image.open(p).size for p in (garden / f"images_{divisor}").iterdir()}
        assert copies == {
            name: (round(width / divisor), round(height / divisor))
            for name, (width, height) in placed.items()
        }
    assert {path.name for path in (garden / "input").iterdir()} == names
    assert (garden / "distorted" / "database.db").is_file()
    distorted = pycolmap.Reconstruction(garden / "distorted" / "sparse" / "0")
    model = pycolmap.Reconstruction(garden / "sparse" / "0")
    assert model.num_reg_images() == distorted.num_reg_images() == 6
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    record = json.loads((garden / "sfm.json").read_text())
    assert list(record["stages"]) == list(STAGES)
    # The alignment can be inverted: the record has the similarity transform.
    scale = record["stages"]["images"]["result"]["scene_from_sfm"]["scale"]
    ours, theirs = (
        sorted(m.images[i].projection_center()[0] for i in m.reg_image_ids())
        for m in (model, distorted)
    )
    assert ours != theirs
    assert scale > 0
    dataset = load_dataset(garden, resolution=2, hold_out=8)
    assert len(dataset.train) + len(dataset.test) == model.num_reg_images()
    assert len(dataset.points) == model.num_points3D()


def test_finished_stages_are_skipped_and_a_changed_photo_is_detected(garden, photos, run, tmp_path):
    before = times(garden)
    again = run("sfm", photos, "-o", garden, *QUICK, "--resize")
    assert again.code == 0
    assert again.out.count("done before") == len(STAGES)
    assert times(garden) == before
    mine = shutil.copytree(photos, tmp_path / "renamed")
    out = shutil.copytree(garden, tmp_path / "moved")
    again = run("sfm", mine, "-o", out, *QUICK, "--resize")
    assert again.out.count("done before") == len(STAGES), again.err

    again = run("sfm", mine, "-o", out, *QUICK)
    assert "images: repeated (changed: resize)" in again.out
    assert again.out.count("done before") == 2

    last = max(mine.iterdir())
    last.unlink()
    again = run("sfm", mine, "-o", out, *QUICK)
    assert "photos: repeated (changed: input)" in again.out
    assert not (out / "input" / last.name).exists()
    assert not (out / "images" / last.name).exists()


def test_photos_in_place(garden, photos, run, refused, tmp_path):
    place = tmp_path / "place"
    shutil.copytree(photos, place / "input")
    before = times(place / "input")
    result = run("sfm", "-s", place, *QUICK)
    assert result.code == 0, result.err
    assert times(place / "input") == before
    assert load_dataset(place).train
    # The original photos are never replaced, not even by a subset of them, or after a move.
    for name in ("place", "moved"):
        place = place.rename(tmp_path / name)
        for inputs in (sorted((place / "input").iterdir())[:5], [photos]):
            line = refused("sfm", *inputs, "-o", place, "--overwrite", *QUICK)
            assert f"{place / 'input'}: contains the original photos" in line
    assert times(place / "input") == before

    # An existing model is only undistorted.
    given = tmp_path / "given"
    shutil.copytree(photos, given / "input")
    shutil.copytree(garden / "distorted" / "sparse", given / "distorted" / "sparse")
    model = (given / "distorted" / "sparse" / "0" / "images.bin").read_bytes()
    assert "distorted" in refused("sfm", "-s", given)  # not created by snowsplat: stays unchanged
    result = run("sfm", "-s", given, "--skip-matching")
    assert result.code == 0, result.err
    assert (given / "distorted" / "sparse" / "0" / "images.bin").read_bytes() == model
    assert len(load_dataset(given).train) == len(load_dataset(garden).train)


def test_positions_in_the_photos_make_the_dataset_metric(garden, photos, run, tmp_path):
    """The same poses, and EXIF positions that are 50 times as far apart: −y of the model is up."""
    place = tmp_path / "place"
    shutil.copytree(garden / "sparse", place / "distorted" / "sparse")
    shutil.copytree(garden / "images", place / "input")
    model = pycolmap.Reconstruction(place / "distorted" / "sparse" / "0")
    home = np.array([52.5, 13.4, 40.0])
    for number in model.reg_image_ids():
        name, centre = model.images[number].name, model.images[number].projection_center()
        latitude, longitude, altitude = location_of(50 * centre[[0, 2, 1]] * (1, 1, -1), home)
        gps = {1: "N", 2: dms(latitude), 3: "E", 4: dms(longitude), 5: b"\0", 6: altitude}
        path = place / "input" / name
        with Image.open(path) as image:
            image.load()
        image.save(path, exif=exif(gps=gps))
    result = run("sfm", "-s", place, "--skip-matching")
    assert result.code == 0, result.err
    assert "\nlevel: from the way the photos were held" in result.out
    assert "\nnorth: +z is north, +x is east; from GPS positions of 6 photos" in result.out
    assert "\nmetric: 1 unit is 1 m, scale from GPS positions of 6 photos" in result.out
    placement = read_placement(place)
    assert placement.is_metric
    record = json.loads((place / "sfm.json").read_text())
    scale = record["stages"]["images"]["result"]["scene_from_sfm"]["scale"]
    assert scale == pytest.approx(50, rel=0.02)
    assert "Level, north and scale" in (place / "dataset_report.html").read_text()


def dms(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds."""
    minutes = 60 * (degrees % 1)
    return float(int(degrees)), float(int(minutes)), 60 * (minutes % 1)


def test_a_folder_with_other_files_stays_unchanged(garden, refused, photos, tmp_path):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine.txt").write_text("mine")
    assert "contains other files (mine.txt)" in refused("sfm", photos, "-o", taken)
    assert "is a file" in refused("sfm", photos, "-o", taken / "mine.txt")
    before = times(garden)
    line = refused("sfm", *sorted(photos.iterdir())[:3], "-o", garden)
    assert "contains a dataset made from" in line
    assert times(garden) == before
    assert [path.name for path in taken.iterdir()] == ["mine.txt"]


def test_a_failure_leaves_no_files(refused, photos, tmp_path):
    two = tmp_path / "two"
    two.mkdir()
    for photo in sorted(photos.iterdir())[:2]:
        shutil.copy(photo, two)
    for inputs in (two, tmp_path / "nothing"):
        refused("sfm", inputs, "-o", tmp_path / "new" / "out")
        assert not (tmp_path / "new" / "out").exists()
    refused("sfm", "-s", tmp_path)
    refused("sfm")
    refused("sfm", photos)
    refused("sfm", photos, "-o", tmp_path / "x", "--threads", 0)
    refused("sfm", photos, "-o", tmp_path / "x", "--skip-matching")
    refused("sfm", photos, "-o", tmp_path / "x", "--fps", 1, "--frames", 20)
    assert sorted(path.name for path in tmp_path.iterdir()) in (["new", "two"], ["two"])


def test_a_full_disk_keeps_finished_stages(garden, photos, run, tmp_path, monkeypatch):
    out = shutil.copytree(garden, tmp_path / "garden")

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("snowsplat.sfm.make_dataset.undistort", full)
    result = run("sfm", photos, "-o", out, *QUICK)
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "the disk is full; free some space, then run the same command again" in result.err
    monkeypatch.undo()
    result = run("sfm", photos, "-o", out, *QUICK)
    assert result.code == 0
    assert result.out.count("done before") == 2
    assert not (out / "images_2").exists()  # that of the command with --resize


@pytest.mark.parametrize("command", ["sfm", pytest.param("make", marks=pytest.mark.nightly)])
def test_without_pycolmap_the_remedy_is_named(photos, tmp_path, command):
    package = tmp_path / "modules" / "pycolmap"
    package.mkdir(parents=True)
    missing = """raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")"""
    (package / "__init__.py").write_text(missing)
    paths = [str(package.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    found = subprocess.run(
        [sys.executable, "-m", "snowsplat", command, photos, "-o", tmp_path / "new", *QUICK],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 2
    assert found.stderr.startswith("snowsplat: pycolmap is not installed")
    assert found.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()
