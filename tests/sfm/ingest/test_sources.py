"""Which files are photos, videos and masks, and their names in input/."""

import os

import pytest

from snowsplat.sfm.ingest.sources import find_sources, free_names, kind_of_file
from snowsplat.util.errors import UserError

from ..pictures import pan, photo, write_photos, write_video


def names(*inputs):
    return [source.name for source in find_sources(inputs).files]


def test_a_folder_is_searched_recursively(tmp_path):
    root = write_photos(tmp_path / "p")
    write_photos(root / "näher dran", 2, "PNG", start=5)
    write_photos(root / "masks", 2, "png")
    write_photos(root / ".thumbnails")
    photo().save(root / ".hidden.jpg")
    photo(200).save(root / "Ünïcode name (1).JPG")
    (root / "notes.txt").write_text("x")
    for name in ("sfm.json", "capture.json", "cfg_args"):
        write_photos(root / f"made with {name}" / "input")
        (root / f"made with {name}" / name).write_text("{}")
    expected = ["0.jpg", "1.jpg", "2.jpg", "näher dran/0.PNG", "näher dran/1.PNG"]
    assert names(root) == sorted([*expected, "Ünïcode name (1).JPG"])


def test_symbolic_links_and_cycles(tmp_path):
    root, other = write_photos(tmp_path / "p"), write_photos(tmp_path / "other", start=5)
    (root / "linked").symlink_to(other)
    (root / "circle").symlink_to(root)
    (other / "back").symlink_to(root)
    (root / "one more.jpg").symlink_to(root / "0.jpg")
    (root / "broken.jpg").symlink_to(root / "nothing.jpg")
    found = find_sources([root])
    expected = ["0.jpg", "1.jpg", "2.jpg", "linked/0.jpg", "linked/1.jpg", "linked/2.jpg"]
    assert [s.name for s in found.files] == expected
    assert found.left_out == [(str(root / "one more.jpg"), "is the same picture as 0.jpg")]


def test_names_of_several_inputs_do_not_collide(tmp_path):
    a, b = write_photos(tmp_path / "a" / "photos", 1), write_photos(tmp_path / "b" / "Photos", 1)
    video = write_video(tmp_path / "photos.mp4", pan(3))
    single = tmp_path / "0.jpg"
    photo().save(single)
    assert names(a, b, video, single) == ["photos/0.jpg", "Photos_2/0.jpg", "photos_3", "0.jpg"]
    assert names(video) == [""]
    assert names(a, a) == ["photos/0.jpg"]


def test_videos_beside_photos_are_skipped_and_named(tmp_path):
    root = write_photos(tmp_path / "p", 2)
    write_video(root / "0.MOV", pan(3))
    found = find_sources([root])
    assert [s.name for s in found.files] == ["0.jpg", "1.jpg"]
    assert found.left_out[0][0].endswith("0.MOV")
    os.remove(root / "0.jpg"), os.remove(root / "1.jpg")
    assert names(root) == [""]
    write_video(root / "1.mkv", pan(3))
    assert names(root) == ["0", "1"]


def test_masks_are_found_by_both_names_and_in_both_folders(tmp_path):
    root = write_photos(tmp_path / "p", 4)
    write_photos(root / "sub", 2, start=5)
    for mask in ("masks/0.jpg.png", "masks/1.PNG", "masks/2.tif", "masks/9.png"):
        (root / mask).parent.mkdir(exist_ok=True)
        photo().save(root / mask)
    for mask in ("masks/sub/0.png", "sub/masks/1.jpg.png"):
        (root / mask).parent.mkdir(exist_ok=True)
        photo().save(root / mask)
    found = find_sources([root])
    masks = [s.mask and s.mask.relative_to(root).as_posix() for s in found.files]
    assert masks == [
        "masks/0.jpg.png",
        "masks/1.PNG",
        "masks/2.tif",
        None,
        "masks/sub/0.png",
        "sub/masks/1.jpg.png",
    ]
    assert found.unused_masks == [root / "masks" / "9.png"]
    assert find_sources([root / "0.jpg"]).files[0].mask == root / "masks" / "0.jpg.png"


def test_the_kind_of_a_file_is_determined_by_its_content(tmp_path):
    for name, content in (("a.heic", b"\0\0\0\x18ftypheic"), ("b.bin", b"\xff\xd8\xff\xe0")):
        (tmp_path / name).write_bytes(content + bytes(40))
        assert kind_of_file(tmp_path / name) == "photo"
    write_video(tmp_path / "a.mp4", pan(2)).rename(tmp_path / "a.jpg")
    assert kind_of_file(tmp_path / "a.jpg") == "video"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.mp4", "not a readable video"),
        ("a.JPG", "not a photo"),
        ("a.txt", "neither a photo nor a video"),
        ("a", "neither"),
        ("a.CR2", "is a raw photo; save it as JPEG"),
    ],
)
def test_text_files_of_any_name(name, message, tmp_path):
    (tmp_path / name).write_text("some text\n" * 100)
    with pytest.raises(UserError, match=message) as caught:
        find_sources([tmp_path / name])
    assert "\n" not in str(caught.value)


def test_no_photos_found(tmp_path):
    with pytest.raises(UserError, match="no such file or folder"):
        find_sources([tmp_path / "absent"])
    with pytest.raises(UserError, match="inputs: none given"):
        find_sources([])
    with pytest.raises(UserError, match="no photos .* and no videos found"):
        find_sources([tmp_path])
    (tmp_path / "IMG_1.dng").write_bytes(b"II*\0")
    with pytest.raises(UserError, match="only raw photos"):
        find_sources([tmp_path])
    with pytest.raises(UserError, match="is a raw photo; save it as JPEG"):
        find_sources([tmp_path / "IMG_1.dng"])


def test_a_name_that_is_not_utf_8(tmp_path):
    root = write_photos(tmp_path / "p", 1)
    os.rename(root / "0.jpg", os.fsencode(root) + b"/caf\xe9.jpg")
    assert names(root) == ["caf?.jpg"]


def test_free_names_are_unique_if_case_is_ignored():
    wanted = ["a.jpg", "A.jpg", "b/a.jpg", "a.jpg", "a_2.jpg"]
    assert list(free_names(wanted)) == ["a.jpg", "A_2.jpg", "b/a.jpg", "a_3.jpg", "a_2_2.jpg"]
