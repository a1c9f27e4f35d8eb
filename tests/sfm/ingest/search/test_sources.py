"""Which files are photos, videos and masks, and their names in input/."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.photo import free_name
from snowsplat.sfm.ingest.search.sources import find_sources, kind_of_file
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError

from ...pictures import pan, photo, write_photos, write_video


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
    for name in ("sfm.json", "cfg_args"):
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
    assert [(each.photo, str(each.reason)) for each in found.left_out] == [
        (str(root), "has links to files that are missing: broken.jpg; copy the files here"),
        (str(root / "one more.jpg"), "is the same picture as 0.jpg"),
    ]


def test_names_of_several_inputs_do_not_collide(tmp_path):
    a, b = write_photos(tmp_path / "a" / "photos", 1), write_photos(tmp_path / "b" / "Photos", 1)
    video = write_video(tmp_path / "photos.mp4", pan(3))
    single = tmp_path / "0.jpg"
    photo().save(single)
    assert names(a, b, video, single) == ["photos/0.jpg", "Photos_2/0.jpg", "photos_3", "0.jpg"]
    assert names(video) == [""]
    assert names(a, a) == ["photos/0.jpg"]


def test_videos_beside_photos_are_skipped_and_named(tmp_path):
    root = write_photos(tmp_path / "p", 3)
    write_video(root / "9.MOV", pan(3))
    found = find_sources([root])
    assert [s.name for s in found.files] == ["0.jpg", "1.jpg", "2.jpg"]
    assert found.left_out[0].photo.endswith("9.MOV")
    for name in ("0.jpg", "1.jpg", "2.jpg"):
        os.remove(root / name)
    assert names(root) == [""]
    write_video(root / "1.mkv", pan(3))
    assert names(root) == ["1", "9"]


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


def test_masks_maps_thumbnails_and_copies_are_no_photos(tmp_path):
    root = write_photos(tmp_path / "p")
    for folder in ("depth", "thumbnails", "confidence_maps"):
        write_photos(root / folder, start=5)
    photo(100).save(root / "0_depth.png")
    photo(20).resize((160, 120)).save(root / "1 (1).jpg")
    mask = Image.fromarray(np.eye(240, 320, dtype=np.uint8) * 255)
    mask.save(root / "2_mask.png")
    mask.save(root / "7_mask.png")
    found = find_sources([root])
    assert {s.name: s.mask and s.mask.name for s in found.files} == {
        "0.jpg": None,
        "1.jpg": None,
        "2.jpg": "2_mask.png",
    }
    assert {each.photo.removeprefix(f"{root}/") for each in found.left_out} == {
        *("depth", "thumbnails", "confidence_maps", "0_depth.png", "1 (1).jpg")
    }
    assert found.unused_masks == [root / "7_mask.png"]


def test_folders_that_are_named_like_maps_may_hold_the_photos(tmp_path):
    write_photos(tmp_path / "p" / "depth")
    assert names(tmp_path / "p") == ["depth/0.jpg", "depth/1.jpg", "depth/2.jpg"]


@pytest.mark.parametrize("folder", ["images", "input"])
def test_of_a_dataset_the_photos_are_used_and_the_poses_named(folder, tmp_path):
    root = write_toy_dataset(tmp_path / "d", "colmap-bin", 3, 32, 24).rename(tmp_path / "e")
    (root / "images_2").mkdir()
    for path in (root / "images").iterdir():
        Image.open(path).reduce(2).save(root / "images_2" / path.name)
    if folder == "input":
        write_photos(root / "input")
        (root / "sfm.json").write_text("{}")
    found = find_sources([root])
    assert {source.path.parent for source in found.files} == {root / folder}
    assert len(found.files) == 3
    (note,) = found.notes
    assert "has camera poses already (sparse/0), which are estimated again" in str(note)
    assert f"snowsplat make {root}" in str(note)
    assert found.posed == root
    assert find_sources([root, root / "images_2"]).posed is None


def test_photos_are_in_the_order_of_their_numbers_and_names_are_short(tmp_path):
    root = write_photos(tmp_path / "p", 11)
    assert names(root) == [f"{i}.jpg" for i in range(11)]
    long = [f"{'雪' * 80}_{i:02d}.jpg" for i in range(3)]
    shorter = [free_name(name, set()) for name in long]
    assert [name[-7:] for name in shorter] == ["_00.jpg", "_01.jpg", "_02.jpg"]
    assert {len(name.encode()) <= 200 for name in shorter} == {True}


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
        ("a.CR2", "is a CR2 photo, which cannot be read; save it as JPEG"),
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
    with pytest.raises(UserError, match="has 1 DNG photo, which cannot be read"):
        find_sources([tmp_path])
    with pytest.raises(UserError, match="is a DNG photo, which cannot be read"):
        find_sources([tmp_path / "IMG_1.dng"])


def test_a_name_that_is_not_utf_8(tmp_path):
    root = write_photos(tmp_path / "p", 1)
    os.rename(root / "0.jpg", os.fsencode(root) + b"/caf\xe9.jpg")
    assert names(root) == ["caf?.jpg"]


def test_free_names_are_unique_if_case_is_ignored():
    wanted = ["a.jpg", "A.jpg", "b/a.jpg", "a.jpg", "a_2.jpg"]
    taken = set()
    made = [free_name(name, taken) for name in wanted]
    assert made == ["a.jpg", "A_2.jpg", "b/a.jpg", "a_3.jpg", "a_2_2.jpg"]


def test_what_lies_beside_photos_is_told_by_name_and_content(tmp_path):
    """As SLAM programs and apps write it; the same names of colour photos are photos."""
    root = write_photos(tmp_path / "p", 3)
    for i, path in enumerate(sorted(root.iterdir())):
        path.rename(root / f"frame_{i:05}.jpg")
        photo(i).save(root / f"frame_{i:05}_masked.jpg")
        Image.new("I;16", (40, 30), 1000 + i).save(root / f"depth{i:05}.png")
        Image.new("L", (40, 30), i).save(root / f"conf_{i:05}.png")
        photo(i).resize((8, 6)).save(root / f"thumb_{i:02}.jpg")
    photo(5).save(root / "a.color.png")
    Image.new("I;16", (40, 30), 1000).save(root / "a.depth.png")
    photo(7).save(root / "depth_00001.jpg")
    photo(8).save(root / "normal_00077.jpg")
    (root / "a.insp").touch()
    found = find_sources([root])
    assert [s.name for s in found.files] == [
        "a.color.png",
        "depth_00001.jpg",
        *(f"frame_{i:05}.jpg" for i in range(3)),
        "normal_00077.jpg",
    ]
    told = {Path(each.photo).name: str(each.reason) for each in found.left_out}
    assert told["depth00000.png"] == "is a depth map of another photo"
    assert told["conf_00002.png"] == "is a confidence map of another photo"
    assert told["thumb_01.jpg"] == "is a small copy of another photo"
    assert told["frame_00001_masked.jpg"] == "is a changed copy of another photo"
    assert "two lenses (INSP); export an equirectangular picture" in told["p"]
