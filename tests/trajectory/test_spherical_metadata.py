"""360° videos: the metadata are in the file, and the frames can still be decoded."""

import av
import numpy as np
import pytest

from snowsplat.sfm.ingest.content.panorama import spherical_video
from snowsplat.trajectory.video_file import mark_as_spherical, video_writer

WIDTH, HEIGHT, FRAMES = 128, 64, 8


def frame(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def write(path, **options):
    with video_writer(path, WIDTH, HEIGHT, 30, **options) as add:
        for i in range(FRAMES):
            add(frame(i))
    return path


def decoded(path) -> list:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def test_a_marked_video_is_a_360_video_of_the_same_frames(tmp_path):
    plain, marked = write(tmp_path / "a.mp4"), write(tmp_path / "b.mp4", panorama=True)
    assert spherical_video(plain) is None
    assert spherical_video(marked) == ""
    kinds = {item.type.name for item in decoded(marked)[0].side_data}
    assert kinds >= {"SPHERICAL", "STEREO3D"}  # as FFmpeg reads version 2
    assert b"<GSpherical:ProjectionType>equirectangular" in marked.read_bytes()  # version 1
    for one, two in zip(decoded(plain), decoded(marked), strict=True):
        assert np.array_equal(one.to_ndarray(format="rgb24"), two.to_ndarray(format="rgb24"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "b.mp4"]


def test_a_video_whose_index_is_at_the_end(tmp_path):
    path = tmp_path / "c.mp4"
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for i in range(FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame(i), format="rgb24")))
        container.mux(stream.encode(None))
    before = [item.to_ndarray(format="rgb24") for item in decoded(path)]
    mark_as_spherical(path)
    assert spherical_video(path) == ""
    assert all(
        np.array_equal(one, two.to_ndarray(format="rgb24"))
        for one, two in zip(before, decoded(path), strict=True)
    )


def test_a_file_without_an_index(tmp_path):
    path = tmp_path / "d.mp4"
    path.write_bytes(b"\0\0\0\x10ftypisomisom")
    with pytest.raises(ValueError, match="no box moov"):
        mark_as_spherical(path)
    assert path.read_bytes() == b"\0\0\0\x10ftypisomisom"
