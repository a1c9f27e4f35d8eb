"""When `make` uses the camera poses of a dataset, and what it says."""

import re
import shutil

import pytest

from snowsplat.pipeline.make_plan import given_poses
from snowsplat.pipeline.observer import Observer
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.synthetic.toy_dataset import write_toy_dataset


class Lines(Observer):
    def __init__(self):
        self.lines = []

    def note(self, line):
        self.lines.append(str(line))


@pytest.fixture
def root(tmp_path):
    return write_toy_dataset(tmp_path / "scan", "colmap-txt", 8)


def used(root):
    """Whether the poses in ``root`` are used, and the lines about them."""
    observer = Lines()
    sources = find_sources([root])
    found = given_poses(sources, DatasetSettings(str(sources.posed)), observer)
    return found is not None, observer.lines


def keep_images(root, count):
    """Leave only the first poses in the model."""
    path = root / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines(True) if line[0] != "#"]
    path.write_text("".join(lines[: 2 * count]))


def test_poses_are_used_and_photos_without_one_are_named(root):
    assert used(root)[0]
    keep_images(root, 6)
    yes, (first, second) = used(root)
    assert yes
    assert "its camera poses are used" in first
    assert f"snowsplat make {root}/images" in first
    assert "2 of 8 photos have no pose" in second
    assert "view_06.png" in second


def test_undistorted_copies_have_the_poses_of_the_photos(root):
    shutil.copytree(root / "images", root / "input")
    (root / "input/view_00.png").rename(root / "input/extra.png")
    yes, (_, line) = used(root)
    assert yes
    assert "1 of 8 photos have no pose" in line
    assert "extra.png" in line


def test_poses_of_few_photos_are_not_used(root):
    keep_images(root, 3)
    yes, (line,) = used(root)
    assert not yes
    assert "estimated again: 5 of 8 photos have no pose" in line


def test_impossible_and_damaged_poses_are_not_used(root):
    cameras = root / "sparse/0/cameras.txt"
    text = cameras.read_text()
    cameras.write_text(re.sub(r"PINHOLE 64 48 \S+ \S+", "PINHOLE 64 48 1.1 1.1", text))
    yes, (line,) = used(root)
    assert not yes
    assert "field of view" in line
    cameras.write_text(text.replace("PINHOLE", "PINHOLED"))
    yes, (line,) = used(root)
    assert not yes
    assert "PINHOLED" in line
