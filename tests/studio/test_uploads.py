"""Uploads: parts in order, resume, paths that lead elsewhere, full disks."""

import shutil
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snowsplat.studio.uploads import NoSpace, WrongPart, received, safe_path, write_part
from snowsplat.util.errors import UserError


@pytest.fixture
def scene(library):
    return library.new("a", [])


def test_a_file_appears_when_it_is_complete(scene):
    assert write_part(scene, "tour/a.jpg", 10, 0, b"01234") == 5
    assert not (scene.photos / "tour/a.jpg").exists()
    assert received(scene) == {"tour/a.jpg": 5}
    assert write_part(scene, "tour/a.jpg", 10, 5, b"56789") == 10
    assert (scene.photos / "tour/a.jpg").read_bytes() == b"0123456789"
    assert received(scene) == {"tour/a.jpg": 10}
    assert write_part(scene, "tour/a.jpg", 10, 5, b"56789") == 10  # its answer was lost
    assert write_part(scene, "empty", 0, 0, b"") == 0
    assert (scene.photos / "empty").read_bytes() == b""


def test_parts_that_do_not_follow(scene):
    write_part(scene, "a.jpg", 10, 0, b"01234")
    for start, data in ((0, b"01234"), (6, b"6789"), (5, b"567890")):
        with pytest.raises(WrongPart) as refused:
            write_part(scene, "a.jpg", 10, start, data)
        assert refused.value.received == 5
    write_part(scene, "a.jpg", 10, 5, b"56789")
    with pytest.raises(WrongPart, match="another file of this name"):
        write_part(scene, "a.jpg", 11, 0, b"other")
    assert (scene.photos / "a.jpg").read_bytes() == b"0123456789"


@pytest.mark.parametrize(
    ("path", "safe"),
    [
        ("../../etc/passwd", "etc/passwd"),
        ("/etc/passwd", "etc/passwd"),
        ("a/../../../b", "a/b"),
        ("..\\..\\windows\\x.jpg", "windows/x.jpg"),
        ("C:\\x.jpg", "C_/x.jpg"),
        ("con.jpg", "_con.jpg"),
        ("a\0b.jpg", "a_b.jpg"),
        ("a/b/c/d/e/f/g/h/i/j/k.jpg", "d/e/f/g/h/i/j/k.jpg"),
        (".ssh/authorized_keys", "ssh/authorized_keys"),
        ("x.jpg.part", "x.jpg"),
    ],
)
def test_paths_stay_inside(scene, path, safe):
    assert safe_path(path).as_posix() == safe
    write_part(scene, path, 1, 0, b"x")
    assert list(received(scene)) == [safe]


@pytest.mark.parametrize("path", ["", "/", "..", "../..", "\\"])
def test_paths_without_a_name(scene, path):
    with pytest.raises(UserError, match="has no name"):
        write_part(scene, path, 1, 0, b"x")


@given(st.text(max_size=300))
def test_no_path_leads_outside(text):
    try:
        path = safe_path(text)
    except UserError:
        return
    assert not path.is_absolute()
    assert ".." not in path.parts


def test_files_in_the_place_of_folders(scene):
    write_part(scene, "a", 1, 0, b"x")
    with pytest.raises(UserError, match="a part of its folder is a file"):
        write_part(scene, "a/b.jpg", 1, 0, b"x")
    write_part(scene, "c/d.jpg", 1, 0, b"x")
    with pytest.raises(UserError, match="there is a folder of this name"):
        write_part(scene, "c", 1, 0, b"x")


def test_a_full_disk(scene, monkeypatch):
    """What a file still needs must be free, and something for the job."""
    with pytest.raises(NoSpace, match="do not fit on the disk"):
        write_part(scene, "huge.mp4", 10**16, 0, b"x")
    assert received(scene) == {}
    write_part(scene, "a.jpg", 10, 0, b"01234")
    usage = SimpleNamespace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(NoSpace, match="free some space"):
        write_part(scene, "a.jpg", 10, 5, b"56789")
    usage.free = 1 << 40
    assert write_part(scene, "a.jpg", 10, 5, b"56789") == 10
