"""Sizes and lengths of videos."""

import pytest

from snowsplat.pipeline.options.video import VideoOptions, VideoSize
from snowsplat.util.errors import UserError

from ..trajectory.rigs import camera_at


def test_sizes_are_even():
    camera = camera_at((0.0, 0.0, -3.0))  # 64×48
    assert VideoSize.parse(None).for_camera(camera) == (64, 48)
    assert VideoSize.parse("127").for_camera(camera) == (126, 94)
    assert VideoSize.parse("33x21").for_camera(camera) == (32, 20)
    large = camera.scaled(4000, 3000)
    assert VideoSize.parse(None).for_camera(large) == (1920, 1440)
    assert VideoSize.parse("8192").for_camera(camera.scaled(1, 100_000)) == (8192, 8192)


def test_number_of_frames():
    assert VideoOptions(seconds=2.0, fps=12.5).frames == 25
    assert VideoOptions(seconds=0.001, fps=1.0).frames == 1
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(UserError, match="above 0"):
            VideoOptions(seconds=wrong)
