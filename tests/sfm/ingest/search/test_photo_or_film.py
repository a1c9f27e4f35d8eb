"""Folders with photos and videos, and photos in formats that are not read."""

import av
import numpy as np
import pytest

from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.util.errors import UserError

from ...pictures import WIDTH, pan, photo, write_photos, write_video


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> bytes:
    return write_video(tmp_path_factory.mktemp("v") / "a.mp4", pan(3)).read_bytes()


def found(root):
    """Names of the used files, and what is said of the others."""
    sources = find_sources([root])
    used = [source.path.name for source in sources.files]
    return used, {each.photo.rpartition("/")[2]: str(each.reason) for each in sources.left_out}


def test_a_video_and_its_thumbnail(tmp_path, video):
    (tmp_path / "VID_1.MP4").write_bytes(video)
    photo(width=160, height=120).save(tmp_path / "vid_1.jpg")
    assert found(tmp_path) == (["VID_1.MP4"], {"vid_1.jpg": "is the thumbnail of VID_1.MP4"})


def test_many_videos_with_thumbnails_of_their_size(tmp_path, video):
    for i in range(4):
        (tmp_path / f"{i}.mp4").write_bytes(video)
        photo(seed=i).save(tmp_path / f"{i}.jpg")
    used, left_out = found(tmp_path)
    assert used == ["0.mp4", "1.mp4", "2.mp4", "3.mp4"]
    assert set(left_out) == {"0.jpg", "1.jpg", "2.jpg", "3.jpg"}


def test_photos_with_a_short_video_each(tmp_path, video):
    """The photos are larger than the frames."""
    for i in range(3):
        (tmp_path / f"{i}.mov").write_bytes(video)
        photo(width=2 * WIDTH, height=600, seed=i).save(tmp_path / f"{i}.jpg")
    used, left_out = found(tmp_path)
    assert used == ["0.jpg", "1.jpg", "2.jpg"]
    assert all("is a video in a folder of photos" in reason for reason in left_out.values())


def test_too_few_photos_beside_a_video(tmp_path, video):
    write_photos(tmp_path, 2)
    (tmp_path / "walk.mp4").write_bytes(video)
    used, left_out = found(tmp_path)
    assert used == ["walk.mp4"]
    assert all("too few for a scene" in reason for reason in left_out.values())


def test_a_damaged_video_among_others(tmp_path, video):
    (tmp_path / "a.mp4").write_bytes(video)
    (tmp_path / "b.mp4").write_bytes(video[:300])
    assert found(tmp_path) == (
        ["a.mp4"],
        {"b.mp4": "is not a readable video, it may be truncated or damaged"},
    )
    write_photos(tmp_path / "c", 2)
    (tmp_path / "c/b.mp4").write_bytes(video[:300])
    assert found(tmp_path / "c")[0] == ["0.jpg", "1.jpg"]


def test_a_recording_of_sound(tmp_path):
    with av.open(str(tmp_path / "voice.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        for i in range(3):
            silence = np.zeros((2, 1024), np.float32)
            frame = av.AudioFrame.from_ndarray(silence, "fltp", "stereo")
            frame.rate, frame.pts = 48000, 1024 * i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(UserError, match=r"voice.mp4: has only sound, no video"):
        find_sources([tmp_path / "voice.mp4"])


def test_formats_that_are_not_read(tmp_path):
    write_photos(tmp_path, 3)
    for i in range(5):
        (tmp_path / f"{i}.CR3").write_bytes(b"raw")  # 0 to 2 are also there as JPEG
        (tmp_path / f"{i + 7}.jxl").write_bytes(b"\xff\x0a")
    assert found(tmp_path)[1] == {
        tmp_path.name: "has 5 JXL and 2 CR3 photos, which cannot be read; save them as JPEG or PNG "
        "first"
    }
    with pytest.raises(UserError, match="is a JXL photo, which cannot be read; save it"):
        find_sources([tmp_path / "7.jxl"])
    for i in range(3):
        (tmp_path / f"{i}.jpg").unlink()
    with pytest.raises(UserError, match="has 5 .* and 5 .* photos, which cannot be read"):
        find_sources([tmp_path])
