"""Frames of a video: sharp, upright, with even steps between them, at most as many as requested."""

import logging
import weakref
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.content.sharpness import BLACK, BLURRED
from snowsplat.sfm.ingest.video.clip import decoded_frames, read_clip
from snowsplat.sfm.ingest.video.video_frames import SAME_VIEW, extract_frames, rgb_image
from snowsplat.sfm.progress import silent

from ...pictures import HEIGHT, WIDTH, blurred, pan, wall, write_video

pytestmark = pytest.mark.slow  # decodes videos


def extract(path, folder, windows, size=None, report=silent):
    folder.mkdir(exist_ok=True)
    return extract_frames(read_clip(path), folder, windows, size, report)


def difference(path, picture) -> float:
    with Image.open(path) as image:
        return float(np.abs(np.asarray(image, np.float64) - picture).mean())


def travel(speeds) -> tuple[list[np.ndarray], np.ndarray]:
    """Images of a camera that moves sideways by ``speeds`` pixels per image, and its places."""
    places = np.concatenate([[0], np.cumsum(speeds)])
    large = wall(width=WIDTH + int(places[-1]))
    return [np.ascontiguousarray(large[:, place : place + WIDTH]) for place in places], places


def uneven_steps(places, frames) -> float:
    """The longest step between ``frames``, divided by the median step."""
    steps = np.diff(places[list(frames)])
    return float(steps.max() / np.median(steps))


def test_sharp_frames_with_even_steps(tmp_path):
    pictures = pan(24)
    sharp = [2, 6, 9, 13, 17, 21]
    frames = [p if i in sharp else blurred(p, 1.5) for i, p in enumerate(pictures)]
    made = extract(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", 6)
    assert [round(10 * frame.seconds) for frame in made.kept] == sharp
    assert made.read == 24
    assert [frame.name for frame in made.kept] == [f"frame_{i:05d}.jpg" for i in range(1, 7)]
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == [f.name for f in made.kept]
    for frame, index in zip(made.kept, sharp, strict=True):
        right, wrong = pictures[index], pictures[index - 1]
        assert difference(tmp_path / "f" / frame.name, right) < 16
        assert difference(tmp_path / "f" / frame.name, wrong) > 20


def test_steps_are_even_where_the_camera_stands_walks_and_runs(tmp_path):
    pictures, places = travel([0] * 20 + [2] * 40 + [12] * 20)
    video = write_video(tmp_path / "a.mp4", pictures, rate=20)
    made = extract(video, tmp_path / "f", 16)
    taken = [round(20 * frame.seconds) for frame in made.kept]
    assert 15 <= len(taken) <= 16
    assert uneven_steps(places, taken) < 1.8
    # The middle frames of 16 equal windows of time.
    assert uneven_steps(places, range(2, 81, 5)) > 5


@pytest.mark.parametrize("speeds", [[1] * 30 + [10] * 20, [10] * 20 + [1] * 30])
def test_the_order_of_slow_and_fast_parts_does_not_matter(speeds, tmp_path):
    """The result does not depend on what is known of the motion at the beginning."""
    pictures, places = travel(speeds)
    made = extract(write_video(tmp_path / "a.mp4", pictures, rate=20), tmp_path / "f", 10)
    taken = [round(20 * frame.seconds) for frame in made.kept]
    assert len(taken) == 10
    assert uneven_steps(places, taken) < 1.8
    assert np.diff(places[taken]).max() < 1.8 * places[-1] / 10


def test_a_short_scene_between_two_cuts_is_kept(tmp_path):
    first, second = pan(14, step=4), pan(4, step=4, seed=7)
    frames = [*first, *second, *pan(14, step=4, seed=9)]
    made = extract(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", 12)
    taken = [round(10 * frame.seconds) for frame in made.kept]
    assert set(taken) & {14, 15, 16, 17}
    assert min(taken) < 6
    assert max(taken) > 26
    assert len(taken) <= 12


def test_few_files_and_few_frames_in_memory(tmp_path, monkeypatch):
    """Also for a video with much motion and few frames to keep."""
    files, alive = [], weakref.WeakSet()

    def decoded(container):
        for frame in decoded_frames(container):
            holder = Held(frame)
            alive.add(holder)
            yield holder
            files.append((len(list((tmp_path / "f").iterdir())), len(alive)))

    monkeypatch.setattr("snowsplat.sfm.ingest.video.video_frames.decoded_frames", decoded)
    monkeypatch.setattr("snowsplat.sfm.ingest.video.video_frames._MIN_COUNT", 5)
    frames = pan(50, step=8)
    made = extract(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", 5)
    assert len(made.kept) == 5
    most_files, most_frames = np.max(files, axis=0)
    assert 5 < most_files <= 20
    assert most_frames <= 3
    assert len(list((tmp_path / "f").iterdir())) == 5


class Held:
    """A decoded frame that a weak reference can follow."""

    def __init__(self, frame):
        self._frame = frame

    def __getattr__(self, name):
        return getattr(self._frame, name)


def test_ctrl_c_is_raised_and_no_candidates_remain(tmp_path):
    def stop(*_):
        raise KeyboardInterrupt

    video = write_video(tmp_path / "a.mp4", pan(25))
    with pytest.raises(KeyboardInterrupt):
        extract(video, tmp_path / "f", 5, report=stop)
    assert not list((tmp_path / "f").iterdir())


def test_a_variable_frame_rate_does_not_matter(tmp_path):
    # 20 frames in the first second, 4 frames in the next three seconds.
    times = [50 * i for i in range(20)] + [1000 + 750 * i for i in range(4)]
    video = write_video(tmp_path / "a.mkv", pan(24), rate=20, times=times)
    assert read_clip(video).seconds == pytest.approx(3.4, abs=0.05)
    made = extract(video, tmp_path / "f", 6)
    taken = [times.index(round(1000 * frame.seconds)) for frame in made.kept]
    assert len(taken) == 6
    assert np.diff(taken).max() <= 6


@pytest.mark.parametrize("rotation", [90, -90])
def test_frames_are_rotated_upright(rotation, tmp_path):
    upright = pan(4)
    turns = {90: 3, -90: 1}[rotation]  # counter-clockwise, undone by the rotation
    frames = [np.ascontiguousarray(np.rot90(picture, turns)) for picture in upright]
    video = write_video(tmp_path / "a.mp4", frames, rotation=rotation)
    made = extract(video, tmp_path / "f", 4)
    assert {(frame.width, frame.height) for frame in made.kept} == {(WIDTH, HEIGHT)}
    assert difference(tmp_path / "f" / made.kept[0].name, upright[0]) < 16


@pytest.mark.parametrize(
    ("aspect", "size", "expected"),
    [(Fraction(4, 3), None, (427, HEIGHT)), (None, 160, (160, 120))],
)
def test_pixels_become_square_and_frames_are_resized(tmp_path, aspect, size, expected):
    video = write_video(tmp_path / "a.mp4", pan(3), aspect=aspect)
    made = extract(video, tmp_path / "f", 1, size)
    assert (made.kept[0].width, made.kept[0].height) == expected
    with Image.open(tmp_path / "f" / "frame_00001.jpg") as image:
        assert image.size == expected


def test_one_frame_is_kept_while_the_camera_does_not_move(tmp_path):
    moving = pan(12)
    frames = [*moving[:4], *[moving[4]] * 8, *moving[5:]]
    made = extract(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", len(frames))
    assert len(made.kept) == len(moving)
    assert [reason for _, reason in made.skipped] == [SAME_VIEW] * 7


def test_frames_without_content_are_skipped(tmp_path):
    frames = pan(8)
    frames[0] = np.zeros_like(frames[0])
    frames[5] = blurred(frames[5], 12)
    made = extract(write_video(tmp_path / "a.mp4", frames), tmp_path / "f", 8)
    assert [(round(t, 1), why) for t, why in made.skipped] == [(0.0, BLACK), (0.5, BLURRED)]
    assert len(made.kept) == 6


def test_a_damaged_video_is_read_as_far_as_possible_with_a_warning(tmp_path, caplog):
    pictures = pan(60, seed=3)
    path = write_video(tmp_path / "a.avi", pictures, codec="mjpeg")
    content = bytearray(path.read_bytes())
    for i in range(len(content) // 3, len(content) // 3 + 60000):
        content[i] = (i * 7919) % 256
    path.write_bytes(content[: len(content) * 3 // 4])
    with caplog.at_level(logging.WARNING, "snowsplat"):
        made = extract(path, tmp_path / "f", 10)
    assert 3 <= len(made.kept) <= 10
    assert made.read < 58
    assert "a.avi: the video is damaged or truncated" in caplog.text


def test_colours(tmp_path):
    """They are correct with the colour matrix of the file, and with the default for its size."""
    colours = np.zeros((720, 1280, 3), np.uint8)
    colours[:360], colours[360:] = (210, 40, 60), (30, 190, 50)
    colours[::16, ::16] = 255  # some detail, as uniform frames are skipped
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 1280, 720, "yuv420p"
        frame = av.VideoFrame.from_ndarray(colours, "rgb24").reformat(
            format="yuv420p", dst_colorspace="ITU709"
        )
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    made = extract(tmp_path / "a.mp4", tmp_path / "f", 1)
    with Image.open(tmp_path / "f" / made.kept[0].name) as image:
        got = np.asarray(image).astype(int)
    assert np.abs(got[104, 104] - (210, 40, 60)).max() <= 6
    assert np.abs(got[600, 104] - (30, 190, 50)).max() <= 6


def test_progress_reaches_the_end(tmp_path):
    calls = []
    video = write_video(tmp_path / "a.mp4", pan(25))
    extract(video, tmp_path / "f", 5, report=lambda *c: calls.append(c))
    assert calls[0] == (10, 25, "frames of a.mp4")
    assert calls[-1] == (25, 25, "frames of a.mp4")


def frame_of(signals, transfer, height=64):
    """A 10-bit BT.2020 frame whose columns have these grey signals (0..1, limited range)."""
    frame = av.VideoFrame(16 * len(signals), height, "yuv420p10le")
    luma = np.repeat([round(64 + 876 * s) for s in signals], 16).astype(np.uint16)
    for plane, values in zip(frame.planes, (luma, None, None), strict=True):
        rows = np.full((plane.height, plane.line_size // 2), 512, np.uint16)
        if values is not None:
            rows[:, : len(values)] = values
        plane.update(rows.tobytes())
    frame.colorspace, frame.color_trc, frame.color_primaries, frame.color_range = 9, transfer, 9, 1
    return frame


def greys(picture):
    assert np.ptp(picture.astype(int), axis=2).max() <= 3  # grey stays grey
    return picture[32, 8::16, 1].astype(int)


@pytest.mark.parametrize(
    ("transfer", "signals"),
    [
        (18, [0.0, 0.3, 0.5, 0.75, 1.0]),  # HLG: diffuse white is 0.75
        (16, [0.0, 0.3, 0.4, 0.58, 0.8]),  # PQ: diffuse white is 0.58
    ],
)
def test_diffuse_white_is_nearly_white_and_highlights_are_brighter(transfer, signals):
    black, dark, middle, white, light = greys(rgb_image(frame_of(signals, transfer)))
    assert black <= 2
    assert 35 < dark < middle < 200
    assert 230 <= white <= 250
    assert white < light <= 255


def test_ten_bits_without_hdr():
    assert np.abs(greys(rgb_image(frame_of([0, 0.5, 1], 1))) - [0, 127.5, 255]).max() <= 2


def test_hdr_colours_keep_their_hue():
    frame = frame_of([0.5, 0.5], 18)
    for plane, value in zip(frame.planes[1:], (470, 580), strict=True):
        plane.update(np.full((plane.height, plane.line_size // 2), value, np.uint16).tobytes())
    red, green, blue = rgb_image(frame)[32, 8].astype(int)
    assert red > green + 30
    assert green > blue
