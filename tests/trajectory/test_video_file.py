"""Videos: decoding returns the written frames, and no partial file is left."""

import math
import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from av.codec.codec import UnknownCodecError

from snowsplat.trajectory import video_file as video_module
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util.errors import UserError

WIDTH, HEIGHT, FRAMES = 64, 48, 10
RATE = 30  # PyAV would take 24 by default


def image(i: int) -> np.ndarray:
    """Colours that change slowly across the image and with time."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    red, green, blue = x * 255 // WIDTH, y * 255 // HEIGHT, 0 * x + 20 * i
    return np.stack([red, green, blue], 2).astype(np.uint8)


def write(path: Path) -> None:
    with video_writer(path, WIDTH, HEIGHT, RATE) as add:
        for i in range(FRAMES):
            add(image(i))


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("encoder", ["libx264", "mpeg4"])
def test_decoded_frames_equal_written_frames(tmp_path, monkeypatch, encoder):
    monkeypatch.setattr(video_module, "_ENCODERS", (encoder,))
    write(tmp_path / "a.mp4")
    frames = decoded(tmp_path / "a.mp4")
    assert len(frames) == FRAMES
    for i, frame in enumerate(frames):
        error = frame[4:-4, 4:-4].astype(int) - image(i)[4:-4, 4:-4]
        # A wrong colour range or matrix would change the mean colour.
        assert abs(error.mean(axis=(0, 1))).max() < 4
        assert abs(error).mean() < 6


def test_size_rate_length_and_index(tmp_path):
    path = tmp_path / "a.mp4"
    write(path)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.pix_fmt) == (WIDTH, HEIGHT, "yuv420p")
        assert stream.average_rate == RATE
        assert stream.codec_context.framerate == RATE
        assert container.duration == pytest.approx(1e6 * FRAMES / RATE, abs=1000)
        assert stream.codec_context.name == "h264"
    content = path.read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_quality_is_that_of_h264_at_crf_18(tmp_path):
    """x264 writes its settings into the stream."""
    write(tmp_path / "a.mp4")
    assert b"crf=18.0" in (tmp_path / "a.mp4").read_bytes()


_PROGRAM = """
import os, sys
from pathlib import Path
import numpy as np
from snowsplat.trajectory.video_file import video_writer

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, list(os.sched_getaffinity(0))[: int(sys.argv[2])])
blocks = np.random.default_rng(0).integers(0, 255, (26, 48, 3), np.uint8)
wall = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
with video_writer(Path(sys.argv[1]), 304, 208, 30) as add:
    for i in range(8):
        add(np.ascontiguousarray(wall[:, 3 * i : 3 * i + 304]))
"""


@pytest.mark.nightly  # two new processes
def test_the_bytes_depend_neither_on_the_content_of_unused_memory_nor_on_processors(tmp_path):
    """glibc fills memory with the complement of MALLOC_PERTURB_ before a program gets it."""
    videos = []
    for fill, processors in ("0", "1"), ("85", "2"):
        file = tmp_path / f"{fill}.mp4"
        subprocess.run(
            [sys.executable, "-c", _PROGRAM, str(file), processors],
            env={**os.environ, "MALLOC_PERTURB_": fill},
            check=True,
        )
        videos.append(file.read_bytes())
    assert videos[0] == videos[1]


def test_other_encoders_get_a_bit_rate(tmp_path, monkeypatch):
    """0.25 bits per pixel, of blocks that change with every frame and need more."""
    monkeypatch.setattr(video_module, "_ENCODERS", ("mpeg4",))
    random = np.random.default_rng(0)
    with video_writer(tmp_path / "a.mp4", 128, 96, 24) as add:
        for _ in range(48):
            blocks = np.kron(random.random((12, 16, 3)), np.ones((8, 8, 1)))
            add((60 * blocks + 90).astype(np.uint8))
    with av.open(str(tmp_path / "a.mp4")) as container:
        bits = container.streams.video[0].codec_context.bit_rate
    assert bits == pytest.approx(0.25 * 128 * 96 * 24, rel=0.4)


def interrupted(path: Path, stop: type[BaseException]) -> None:
    with video_writer(path, WIDTH, HEIGHT, 24) as add:
        add(image(0))
        raise stop


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_a_block_that_raises_leaves_no_file(tmp_path, stop):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(stop):
        interrupted(tmp_path / "a.mp4", stop)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_a_full_disk_raises_and_leaves_no_file(tmp_path):
    """The full disk is simulated by a limit of the file size."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(UserError, match="a.mp4: the video cannot be written"):
            write(tmp_path / "a.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_invalid_arguments_are_rejected(tmp_path, monkeypatch):
    sizes = ((63, 48), 24), ((64, 47), 24), ((0, 0), 24)
    for size, fps in (*sizes, ((64, 48), 0), ((64, 48), math.inf), ((64, 48), math.nan)):
        with (
            pytest.raises(ValueError, match="a video needs"),
            video_writer(tmp_path / "a.mp4", *size, fps),
        ):
            pass
    with (
        pytest.raises(ValueError, match="does not fit"),
        video_writer(tmp_path / "a.mp4", 66, HEIGHT, 24) as add,
    ):
        add(image(0))
    monkeypatch.setattr(video_module, "_ENCODERS", ("no_such_encoder",))
    with pytest.raises(UserError, match="cannot encode videos"):
        write(tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("available", "used"),
    [
        ({"mpeg4", "libopenh264", "libx264"}, "libx264"),
        ({"mpeg4", "libopenh264"}, "libopenh264"),
        ({"mpeg4"}, "mpeg4"),
    ],
)
def test_the_first_available_encoder_is_used(monkeypatch, available, used):
    def codec(name: str, mode: str) -> None:
        if name not in available:
            raise UnknownCodecError(name)

    monkeypatch.setattr("av.codec.Codec", codec)
    assert video_module._encoder() == used
