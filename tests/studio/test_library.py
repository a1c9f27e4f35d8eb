"""Scenes of the library: names, inputs, damaged files."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio.library import Library, UnknownScene, safe_name
from snowsplat.util.errors import UserError

from .conftest import of_the_command_line


def test_a_new_scene_is_found_again(library, tmp_path):
    scene = library.new("Häuser am See", [])
    assert scene.job.title == "Häuser am See"
    assert library.find(scene.name).folder == scene.folder
    again = library.new("Häuser am See", [])
    assert again.name != scene.name
    os.utime(again.folder)
    assert {each.name for each in Library(library.folder).scenes()} == {scene.name, again.name}
    with pytest.raises(UserError, match="No such file or directory"):
        library.new("x", [tmp_path / "absent"])


@pytest.mark.parametrize(
    "name", ["..", ".", "", "../library", "a/b", "absent", "a\0b", "\\x", "x" * 500]
)
def test_names_that_are_no_scenes(library, name):
    library.new("a", [])
    with pytest.raises(UnknownScene):
        library.find(name)


def test_what_a_scene_is_made_of(library):
    scene = library.new("a", [])
    with pytest.raises(UserError, match="there are no photos yet"):
        scene.inputs()
    scene.photos.mkdir()
    (scene.photos / "one.mp4").touch()
    assert scene.inputs() == [scene.photos / "one.mp4"]
    (scene.photos / "two.jpg").touch()
    (scene.photos / ".hidden").touch()
    assert scene.inputs() == [scene.photos]
    # A zip file is unpacked beside it when the photos are looked at.
    (scene.photos / "more.zip").touch()
    (scene.photos / "more").mkdir()
    assert [path.name for path in scene.inputs()] == ["more.zip", "one.mp4", "two.jpg"]


def test_a_damaged_job_is_named(library):
    scene = library.new("a", [])
    (scene.folder / "job.json").write_text("{")
    with pytest.raises(UserError, match=r"job\.json: damaged"):
        _ = scene.job


def test_output_folders_of_the_command_line_are_scenes(library):
    (library.folder / "photos").mkdir()
    (library.folder / "photos/a.jpg").touch()
    file = of_the_command_line(library.folder / "The tour: 1")
    (scene,) = library.scenes()
    assert (scene.found, scene.job.title) == (True, "The tour: 1")
    assert library.find(scene.name).scene_file() == file
    scene.change(title="A tour")
    assert StudioScene(scene.folder).job.title == "A tour"
    assert {each.name for each in scene.folder.iterdir()} == {
        "cfg_args",
        "point_cloud",
        "studio",
    }
    for action in (scene.inputs, scene.remove):
        with pytest.raises(UserError, match="made in a terminal"):
            action()
    assert file.is_file()


def test_a_scene_is_removed_without_its_photos(library, tmp_path):
    other = library.new("other", [])
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept.txt").touch()
    scene = library.new("a", [])
    (scene.made / "dataset").mkdir(parents=True)
    (scene.made / "link").symlink_to(outside)
    scene.site.symlink_to(outside)
    scene.write_state({"outcome": "done"})
    scene.photos.mkdir()
    (scene.photos / "one.jpg").touch()
    assert scene.remove() == scene.photos
    assert [path.name for path in scene.folder.rglob("*")] == ["photos", "one.jpg"]
    assert [each.name for each in library.scenes()] == ["other"]
    assert (outside / "kept.txt").is_file()
    assert other.remove() is None
    assert not other.folder.exists()
    link = library.folder / "link"
    link.symlink_to(library.new("b", []).folder)
    with pytest.raises(UserError, match="made in a terminal"):
        StudioScene(link).remove()


@given(st.text())
def test_safe_names_are_names(text):
    name = safe_name(text)
    assert name not in ("", ".", "..")
    assert Path(name).name == name
    assert not set(name) & set('/\\:*?"<>|\0')
    assert len(name.encode()) < 255
    assert safe_name(name) == name
