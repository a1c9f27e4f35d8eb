"""`snowsplat info` of photos and videos: what would be used of them."""

import zipfile

import numpy as np
import pytest
from PIL import Image
from tests.sfm.pictures import exif, pan, photo, write_video

from snowsplat.pipeline.describe import describe
from snowsplat.util.errors import UserError


def test_photos_are_counted_with_what_is_known_of_them(tmp_path):
    for i in range(3):
        photo(8 * i).save(tmp_path / f"{i}.jpg", exif=exif({0x010F: "Maker"}, {0xA405: 28}))
    photo(30).save(tmp_path / "3.png")
    (tmp_path / "4.jpg").write_bytes(b"\xff\xd8\xff nothing")
    (tmp_path / "masks").mkdir()
    for name in ("0.png", "other.png"):
        Image.fromarray(np.full((8, 8), 255, np.uint8)).save(tmp_path / "masks" / name)
    facts = describe(tmp_path)
    assert facts["kind"] == "photos"
    assert facts["photos"] == 4
    assert facts["formats"] == {"JPEG": 3, "PNG": 1}
    assert facts["with_focal_length"] == 3
    assert any("Maker" in camera for camera in facts["cameras"])
    assert facts["masks"] == 1
    assert [name for name in facts["not_used"] if name.endswith("4.jpg")]
    assert [name for name in facts["unused_masks"] if name.endswith("other.png")]
    assert facts["next"] == f"snowsplat make {tmp_path}"


def test_a_video_is_described(tmp_path):
    write_video(tmp_path / "walk.mp4", pan(20))
    (line,) = describe(tmp_path / "walk.mp4")["videos"].values()
    assert str(line).endswith("of 20 frames will be used")


def test_a_folder_without_photos_and_poses_is_refused(tmp_path):
    with pytest.raises(UserError, match="no camera poses here"):
        describe(tmp_path)
    (tmp_path / "1.dng").write_bytes(b"II*\0")
    with pytest.raises(UserError, match="has 1 DNG photo, which cannot be read"):
        describe(tmp_path)
    (tmp_path / "1.jpg").write_bytes(b"\xff\xd8\xff nothing")
    with pytest.raises(UserError, match="none of its 1 photos can be used .* cannot be decoded"):
        describe(tmp_path)


def test_a_zip_file_is_described_and_not_unpacked(tmp_path):
    photo().save(tmp_path / "1.jpg")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "1.jpg", "x/1.jpg")
        archive.writestr("x/notes.txt", "text")
    facts = describe(tmp_path / "a.zip")
    assert (facts["kind"], facts["photos"], facts["videos"], facts["files"]) == (
        "zip file",
        1,
        0,
        2,
    )
    assert {path.name for path in tmp_path.iterdir()} == {"1.jpg", "a.zip"}
