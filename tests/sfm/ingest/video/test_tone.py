"""Tone mapping of HDR video frames."""

import av
import numpy as np
import pytest

from snowsplat.sfm.ingest.video.tone import rgb_image


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
