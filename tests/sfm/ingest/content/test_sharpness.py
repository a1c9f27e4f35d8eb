"""Sharpness, and images without content."""

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.content.sharpness import (
    BLACK,
    BLURRED,
    FLAT,
    WHITE,
    grey_copy,
    sharpness,
    why_unusable,
)

from ...pictures import blurred, grey, noisy, pan, wall


def test_grey_copy_has_the_requested_side_and_is_never_larger():
    assert grey_copy(Image.new("RGB", (4000, 3000)), 320).shape == (240, 320)
    assert grey_copy(Image.new("RGB", (700, 1000)), 320).shape == (320, 224)
    assert grey_copy(Image.new("L", (100, 60)), 320).shape == (60, 100)
    assert grey_copy(Image.new("RGB", (5000, 3)), 320).shape == (1, 320)


def test_sharpness_decreases_with_blur():
    values = [sharpness(grey(blurred(wall(), radius))) for radius in (0, 0.5, 1, 2)]
    assert values == sorted(values, reverse=True)
    assert values[1] < 0.9 * values[0]


def test_motion_blur_decreases_sharpness():
    frames = pan(8, step=2)
    smeared = np.mean(frames, axis=0).astype(np.uint8)
    assert sharpness(grey(smeared)) < 0.7 * min(sharpness(grey(frame)) for frame in frames)


@pytest.mark.parametrize("level", [0, 3])
@pytest.mark.parametrize(("value", "reason"), [(0, BLACK), (255, WHITE), (128, FLAT)])
def test_uniform_images_are_useless(value, reason, level):
    picture = np.full((960, 1280, 3), value, np.uint8)
    assert why_unusable(grey(noisy(picture, level, seed=1))) == reason


def test_only_strongly_blurred_images_are_useless():
    large = wall(width=1280, height=960)
    assert why_unusable(grey(large)) is None
    assert why_unusable(grey(blurred(large, 6))) is None
    assert why_unusable(grey(blurred(large, 32))) == BLURRED


def test_dark_images_with_little_contrast_are_used():
    dim = (wall(width=640, height=480) / 16).astype(np.uint8)
    assert why_unusable(grey(dim)) is None
