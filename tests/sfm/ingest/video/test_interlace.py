"""Interlaced videos, with and without the mark, and videos that only have the mark."""

import av
import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.video.clip import read_clip
from snowsplat.sfm.ingest.video.interlace import field_order
from snowsplat.sfm.ingest.video.video_frames import extract_frames
from snowsplat.sfm.progress import silent

from ...pictures import pan, write_video


def woven(pictures, first_row) -> list[np.ndarray]:
    """Frames with one row in two of each of two successive pictures."""
    frames = []
    for early, late in zip(pictures[::2], pictures[1::2], strict=True):
        frame = late.copy()
        frame[first_row::2] = early[first_row::2]
        frames.append(frame)
    return frames


def combs(frame) -> float:
    """The difference between neighbouring rows, divided by that between rows of one field."""
    grey = np.asarray(frame, np.float64).mean(-1)
    return np.abs(np.diff(grey, axis=0)).mean() / np.abs(grey[2:] - grey[:-2]).mean()


@pytest.mark.parametrize(
    ("name", "first_row", "order"),
    [("a.mp4", 1, "bff"), ("a.h264", 0, "tff")],  # the latter has no index for jumps
)
def test_frames_become_those_of_one_field(tmp_path, name, first_row, order):
    pictures = pan(24, step=4)
    frames = woven(pictures, first_row)
    clip = read_clip(write_video(tmp_path / name, frames, rate=25))
    assert field_order(clip) == order
    (tmp_path / "f").mkdir()
    made = extract_frames(clip, tmp_path / "f", 6, None, silent)
    assert any("interlaced" in str(line) for line in made.notes)
    assert len(made.kept) == 6
    for frame in made.kept:
        with Image.open(tmp_path / "f" / frame.name) as image:
            got = np.asarray(image)
        index = round(25 * frame.seconds)
        assert combs(frames[index]) > 1
        assert combs(got) < 0.8
        early, late = (np.abs(got.astype(float) - p).mean() for p in pictures[2 * index :][:2])
        assert early < 0.8 * late  # the moment of the first field


@pytest.mark.parametrize("mark", ["+ildct+ilme", None])
def test_whole_frames_stay_as_they_are(tmp_path, mark):
    """Some cameras store whole frames in a stream that is marked as interlaced."""
    with av.open(str(tmp_path / "a.mpg"), "w") as container:
        stream = container.add_stream(
            "mpeg2video", rate=25, options={"flags": mark} if mark else {}
        )
        stream.width, stream.height = 320, 240
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for picture in pan(12, step=5):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())
    assert field_order(read_clip(tmp_path / "a.mpg")) is None


def test_a_camera_that_stands_still(tmp_path):
    assert field_order(read_clip(write_video(tmp_path / "a.mp4", pan(1) * 8))) is None
