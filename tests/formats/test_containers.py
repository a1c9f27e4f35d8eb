"""Containers as people make them: zipped folders, gzip members, pointers, folders of one scene."""

import gzip
import shutil
import zipfile

import numpy as np
import pytest
import torch

from snowsplat.data.photos.decode import read_header
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.project.project import Project
from snowsplat.util.errors import UserError


@pytest.mark.parametrize("name", ["a.sog", "a.zip"])
def test_sog_zipped_with_its_folder(tmp_path, make_scene, name):
    write_gaussians(tmp_path / "scene.sog", make_scene(20, 1))
    with (
        zipfile.ZipFile(tmp_path / "scene.sog") as whole,
        zipfile.ZipFile(tmp_path / name, "w") as outer,
    ):
        for member in whole.namelist():
            outer.writestr(f"scene/{member}", whole.read(member))
        outer.writestr("__MACOSX/scene/meta.json", b"\0")
    means = read_gaussians(tmp_path / name).means
    assert torch.equal(means, read_gaussians(tmp_path / "scene.sog").means)


@pytest.mark.parametrize("cut", [3, 40, 200])
def test_spz_of_two_gzip_members(tmp_path, make_scene, cut):
    write_gaussians(tmp_path / "a.spz", make_scene(20, 1))
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    parts = gzip.compress(data[:cut]) + gzip.compress(data[cut:])
    (tmp_path / "b.spz").write_bytes(parts)
    means = read_gaussians(tmp_path / "b.spz").means
    assert torch.equal(means, read_gaussians(tmp_path / "a.spz").means)
    for damaged in (parts[:-4], gzip.compress(data[:cut])):
        (tmp_path / "c.spz").write_bytes(damaged)
        with pytest.raises(UserError):
            read_gaussians(tmp_path / "c.spz")


@pytest.mark.parametrize(("name", "read"), [("a.ply", read_gaussians), ("a.jpg", read_header)])
def test_a_pointer_of_git_lfs_is_named(tmp_path, name, read):
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n"
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match="is a pointer of Git LFS; run git lfs pull"):
        read(tmp_path / name)


def test_a_folder_of_one_scene_is_that_scene(tmp_path, make_scene):
    """As `publish` writes; not a folder of photos, or of several scenes."""
    write_gaussians(tmp_path / "scene.sog", make_scene(20, 1))
    (tmp_path / "poster.jpg").touch()
    assert Project.open(tmp_path).scene == tmp_path / "scene.sog"
    (tmp_path / "photo.jpg").touch()
    assert Project.open(tmp_path).scene is None
    (tmp_path / "photo.jpg").unlink()
    (tmp_path / "points.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    assert Project.open(tmp_path).scene == tmp_path / "scene.sog"
    shutil.copy(tmp_path / "scene.sog", tmp_path / "other.sog")
    assert Project.open(tmp_path).scene is None


def test_what_is_lost_of_a_ply_is_named(tmp_path, make_scene, caplog):
    write_gaussians(tmp_path / "a.ply", make_scene(3, 0))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    rows = np.frombuffer(body, np.uint8).reshape(3, -1)
    more = np.arange(3, dtype="<i4").view(np.uint8).reshape(3, 4)
    head = head.replace(b"element", b"comment Vertical Axis: z\nelement")
    data = head + b"property int semantic_id\nend_header\n" + np.hstack([rows, more]).tobytes()
    (tmp_path / "b.ply").write_bytes(data)
    assert torch.equal(
        read_gaussians(tmp_path / "b.ply").means, read_gaussians(tmp_path / "a.ply").means
    )
    assert "not read, and lost: semantic_id" in caplog.text
    assert "its z axis is up; to turn it upright, convert with --rotate 90 0 0" in caplog.text
