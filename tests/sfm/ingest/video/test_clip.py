"""The length of a video, independent of its header, and the number of frames to use."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from snowsplat.sfm.ingest.video.clip import (
    Clip,
    decoded_frames,
    max_frame_count,
    open_video,
    read_clip,
)
from snowsplat.util.errors import UserError

from ...pictures import HEIGHT, WIDTH, pan, write_video


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.mp4", "libx264"),
        ("a.mov", "libx264"),
        ("a.m4v", "mpeg4"),
        ("a.mkv", "libx264"),
        ("a.avi", "mjpeg"),
        ("a.webm", "libvpx"),
        ("a.mpg", "mpeg2video"),
        ("a.h264", "libx264"),
    ],
)
def test_containers(name, codec, tmp_path):
    rate = 25  # supported by MPEG-2
    clip = read_clip(write_video(tmp_path / name, pan(20), rate=rate, codec=codec))
    assert clip.packets == 20
    assert clip.seconds == pytest.approx(20 / rate, rel=0.06)
    assert (clip.width, clip.height) == (WIDTH, HEIGHT)
    with open_video(clip.path) as container:
        assert len(list(decoded_frames(container))) == 20


def test_a_rotated_video(tmp_path):
    clip = read_clip(write_video(tmp_path / "a.mp4", pan(3), rotation=90))
    assert (clip.width, clip.height) == (HEIGHT, WIDTH)


def test_non_square_pixels(tmp_path):
    video = write_video(tmp_path / "a.mp4", pan(3), aspect=Fraction(4, 3), rotation=90)
    clip = read_clip(video)
    assert (clip.width, clip.height) == (HEIGHT, 427)


def test_empty_truncated_and_text_files(tmp_path):
    video = write_video(tmp_path / "a.mp4", pan(20)).read_bytes()
    for content in (b"", video[:500], b"text\n" * 500):
        (tmp_path / "b.mp4").write_bytes(content)
        with pytest.raises(UserError, match=r"b.mp4: no frame of this video can be decoded.*copy"):
            read_clip(tmp_path / "b.mp4")


def write_streams(path, films) -> None:
    """A file with several video streams: (pictures, codec, disposition) each."""
    with av.open(str(path), "w") as container:
        streams = []
        for pictures, codec, disposition in films:
            stream = container.add_stream(codec, rate=10)
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.disposition = disposition
            streams.append(stream)
        for stream, (pictures, _, _) in zip(streams, films, strict=True):
            for picture in pictures:
                frame = av.VideoFrame.from_ndarray(picture, "rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_the_film_is_read_and_not_a_cover_or_a_preview(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    small = [np.ascontiguousarray(picture[::2, ::2]) for picture in pan(6)]
    cover, default = Disposition.attached_pic, Disposition.default
    none = Disposition(0)
    write_streams(
        path,
        [(pan(1), "mjpeg", cover), (small, "libx264", none), (pan(6), "libx264", none)],
    )
    found = read_clip(path)
    assert (found.width, found.packets) == (WIDTH, 6)
    with open_video(path) as container:
        assert len(list(decoded_frames(container))) == 6
    write_streams(path, [(small, "libx264", default), (pan(6), "libx264", none)])
    assert read_clip(path).width == WIDTH
    write_streams(path, [(pan(6), "libx264", none), (pan(4), "libx264", default)])
    assert read_clip(path).packets == 4


def test_a_file_with_only_a_cover_picture(tmp_path):
    write_streams(tmp_path / "a.mp4", [(pan(1), "mjpeg", Disposition.attached_pic)])
    with pytest.raises(UserError, match=r"a.mp4: has no video; use"):
        read_clip(tmp_path / "a.mp4")


def clip(seconds, rate=30):
    packets = round(seconds * rate)
    return Clip(Path("a.mp4"), packets, packets, 0.0, seconds, 1920, 1080)


@pytest.mark.parametrize(
    ("seconds", "frames"),
    [(0.1, 2), (2, 30), (10, 60), (23.5, 60), (40, 100), (100, 150), (200, 200), (3600, 300)],
)
def test_default_number_of_frames(seconds, frames):
    assert max_frame_count(clip(seconds), None, None) == pytest.approx(frames, abs=1)


def test_requested_number_of_frames_is_limited_by_the_video():
    assert max_frame_count(clip(10), 2.0, None) == 20
    assert max_frame_count(clip(10), None, 77) == 77
    assert max_frame_count(clip(10), 1000.0, None) == 300
    assert max_frame_count(clip(10), 0.01, None) == 1
