"""Uploads: parts in order, resume, paths that lead elsewhere, full disks."""

import os
import shutil
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES
from snowsplat.studio import uploads
from snowsplat.studio.given_photos import find_given, first_given, given_photos, leave_out
from snowsplat.studio.library import UnknownScene
from snowsplat.studio.picture_requests import small_jpeg
from snowsplat.studio.uploads import NoSpace, Upload, WrongPart, safe_path, write_part
from snowsplat.util.errors import UserError


@pytest.fixture
def scene(library):
    return library.new("a", [])


def send(scene, path: str, size: int, start: int, data: bytes, modified: int = 7) -> int:
    return write_part(scene, Upload(path, size, modified, start), data)


def received(scene) -> dict[str, int]:
    return {file.path: file.received for file in uploads.uploads(scene)}


def test_a_file_appears_when_it_is_complete(scene):
    assert send(scene, "tour/a.jpg", 10, 0, b"01234") == 5
    assert not (scene.photos / "tour/a.jpg").exists()
    assert received(scene) == {"tour/a.jpg": 5}
    assert send(scene, "tour/a.jpg", 10, 5, b"56789") == 10
    assert (scene.photos / "tour/a.jpg").read_bytes() == b"0123456789"
    assert received(scene) == {"tour/a.jpg": 10}
    assert send(scene, "tour/a.jpg", 10, 5, b"56789") == 10  # its answer was lost
    assert send(scene, "empty", 0, 0, b"") == 0
    assert (scene.photos / "empty").read_bytes() == b""


def test_a_photo_that_is_left_out(scene):
    """It is moved aside, is not sent again with its folder, and comes back."""
    send(scene, "tour/a.jpg", 3, 0, b"012")
    send(scene, "tour/b.jpg", 3, 0, b"012")
    leave_out(scene, "tour/a.jpg", True)
    assert received(scene) == {"tour/b.jpg": 3}
    assert [(p.name, p.out) for p in given_photos(scene)] == [
        ("tour/a.jpg", True),
        ("tour/b.jpg", False),
    ]
    assert send(scene, "tour/a.jpg", 3, 0, b"012") == 3
    assert received(scene) == {"tour/b.jpg": 3}
    for name, out in (("tour/a.jpg", True), ("../a.jpg", True), ("tour/b.jpg", False)):
        with pytest.raises(UnknownScene):
            leave_out(scene, name, out)
    leave_out(scene, "tour/a.jpg", False)
    assert received(scene) == {"tour/a.jpg": 3, "tour/b.jpg": 3}


def test_every_photo_that_sfm_uses_can_be_left_out(scene):
    """The small picture of each of them is found, too, without a list of the folder."""
    names = [f"a{number}{suffix}" for number, suffix in enumerate(sorted(PHOTO_SUFFIXES))]
    for name in names:
        send(scene, name, 1, 0, b"0")
    assert [photo.name for photo in given_photos(scene)] == names
    for name in names:
        leave_out(scene, name, True)
        assert find_given(scene, name).out
    assert received(scene) == {}


def test_the_small_picture_of_a_photo_of_a_phone(scene):
    pillow_heif = pytest.importorskip("pillow_heif")
    scene.photos.mkdir(exist_ok=True)
    pillow_heif.from_pillow(Image.new("RGB", (64, 48))).save(scene.photos / "a.heic")
    assert small_jpeg(find_given(scene, "a.heic").path).startswith(b"\xff\xd8")


def test_photos_in_a_folder_of_the_user_stay(library, tmp_path):
    (tmp_path / "a.jpg").touch()
    scene = library.new("a", [tmp_path])
    with pytest.raises(UserError, match="remove the photo there"):
        leave_out(scene, "a.jpg", True)
    assert (tmp_path / "a.jpg").exists()
    assert first_given(scene) == tmp_path / "a.jpg"  # its picture on the start page


def test_killed_before_a_complete_file_has_its_name(scene, monkeypatch):
    """Its last part is sent again, or an empty one; or it is listed."""
    for name, start, data in (("a.jpg", 5, b"56789"), ("b.jpg", 10, b""), ("c.jpg", None, b"")):
        send(scene, name, 10, 0, b"01234")
        with monkeypatch.context() as patch:
            patch.setattr(os, "utime", lambda *_, **__: {}["killed"])
            with pytest.raises(KeyError):
                send(scene, name, 10, 5, b"56789")
        assert not (scene.photos / name).exists()
        if start is None:
            assert received(scene)[name] == 10
        else:
            assert send(scene, name, 10, start, data) == 10
        assert (scene.photos / name).read_bytes() == b"0123456789"


def test_parts_that_do_not_follow(scene):
    send(scene, "a.jpg", 10, 0, b"01234")
    for start, data in ((0, b"01234"), (6, b"6789"), (5, b"567890")):
        with pytest.raises(WrongPart) as refused:
            send(scene, "a.jpg", 10, start, data)
        assert refused.value.received == 5
    send(scene, "a.jpg", 10, 5, b"56789")
    assert (scene.photos / "a.jpg").read_bytes() == b"0123456789"


def test_files_of_the_same_name_are_kept(scene):
    """Parts of two files are never mixed; a file that is there already is not kept twice."""
    send(scene, "a.jpg", 10, 0, b"01234")
    send(scene, "a.jpg", 10, 0, b"abcde", modified=8)
    send(scene, "a.jpg", 8, 0, b"ABCD")
    assert {(f.size, f.modified, f.received) for f in uploads.uploads(scene)} == {
        (10, 7, 5),
        (10, 8, 5),
        (8, 7, 4),
    }
    with pytest.raises(UserError, match="no photos yet"):
        scene.inputs()  # nothing is complete
    send(scene, "a.jpg", 10, 5, b"fghij", modified=8)
    send(scene, "a.jpg", 10, 5, b"56789")
    send(scene, "a.jpg", 8, 4, b"EFGH")
    files = {"a.jpg": b"abcdefghij", "a-2.jpg": b"0123456789", "a-3.jpg": b"ABCDEFGH"}
    for _ in range(2):
        assert {file.name: file.read_bytes() for file in scene.photos.iterdir()} == files
        assert send(scene, "a.jpg", 10, 0, b"01234") == 10  # dropped again
        assert send(scene, "a.jpg", 8, 0, b"ABCDEFGH", modified=9) == 8  # a copy
    with pytest.raises(UserError, match="9999"):
        send(scene, "a.jpg", 10, 0, b"01234", modified=10**17)


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
    send(scene, path, 1, 0, b"x")
    assert list(received(scene)) == [safe]


@pytest.mark.parametrize("path", ["", "/", "..", "../..", "\\"])
def test_paths_without_a_name(scene, path):
    with pytest.raises(UserError, match="has no name"):
        send(scene, path, 1, 0, b"x")


@given(st.text(max_size=300))
def test_no_path_leads_outside(text):
    try:
        path = safe_path(text)
    except UserError:
        return
    assert not path.is_absolute()
    assert ".." not in path.parts


def test_files_in_the_place_of_folders(scene):
    send(scene, "a", 1, 0, b"x")
    with pytest.raises(UserError, match="a part of its folder is a file"):
        send(scene, "a/b.jpg", 1, 0, b"x")
    send(scene, "c/d.jpg", 1, 0, b"x")
    send(scene, "c", 1, 0, b"x")
    assert (scene.photos / "c-2").read_bytes() == b"x"


def test_a_full_disk(scene, monkeypatch):
    """What a file still needs must be free, and something for the job."""
    with pytest.raises(NoSpace, match="do not fit on the disk"):
        send(scene, "huge.mp4", 10**16, 0, b"x")
    assert received(scene) == {}
    send(scene, "a.jpg", 10, 0, b"01234")
    usage = SimpleNamespace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(NoSpace, match="free some space"):
        send(scene, "a.jpg", 10, 5, b"56789")
    usage.free = 1 << 40
    assert send(scene, "a.jpg", 10, 5, b"56789") == 10
