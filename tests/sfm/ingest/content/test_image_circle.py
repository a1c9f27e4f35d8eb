"""The disc of a fisheye lens is found; dark corners of other photos are no disc."""

import numpy as np
import pytest

from snowsplat.sfm.ingest.content.fixed_parts import describe, find_fixed_parts
from snowsplat.sfm.ingest.content.image_circle import find_image_circle
from snowsplat.util.messages import message

HEIGHT, WIDTH = 240, 320
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH] + 0.5


def photos(light, stray=4.0) -> np.ndarray:
    """(8, H, W): random patches, multiplied by ``light`` (H, W), with stray light and noise."""
    random = np.random.default_rng(0)
    patches = np.kron(random.uniform(20, 255, (8, 20, 20)), np.ones((12, 16)))
    noisy = patches * light + stray + random.normal(0, 2, (8, HEIGHT, WIDTH))
    return noisy.clip(0, 255).astype(np.uint8)


def disc(x, y, radius) -> np.ndarray:
    return np.hypot(COLUMNS - x, ROWS - y) < radius


@pytest.mark.parametrize("circle", [(160, 120, 115), (166, 117, 108), (160, 120, 150)])
@pytest.mark.parametrize("stray", [0.0, 20.0])
def test_a_disc_is_found(circle, stray):
    found = find_image_circle(photos(disc(*circle), stray))
    np.testing.assert_allclose((found.x, found.y, found.radius), circle, atol=2.5)
    outside = found.outside((HEIGHT, WIDTH))
    assert outside[~disc(*circle)].all()
    assert outside[disc(*circle)].mean() < 0.08


@pytest.mark.parametrize(
    "light",
    [
        np.ones((HEIGHT, WIDTH)),
        1 - 0.95 * (np.hypot(COLUMNS - 160, ROWS - 120) / 200) ** 2,  # vignetting
        (np.abs(COLUMNS - 160) < 110) & (np.abs(ROWS - 120) < 90),  # a frame
        (np.abs(COLUMNS - 160) < 80) * 1.0,  # bars
        np.abs(COLUMNS - 160) / 1.5 + np.abs(ROWS - 120) < 110,  # a rhomb
    ],
)
def test_other_dark_corners_are_no_disc(light):
    assert find_image_circle(photos(light)) is None


def test_what_is_outside_of_a_disc_is_fixed():
    parts = find_fixed_parts(photos(disc(160, 120, 115)))
    assert parts.crop is None
    assert (parts.overlays == parts.fixed).all()
    assert parts.fixed[5, 5]
    assert not parts.fixed[120, 160]
    (line,) = map(str, describe(parts, False, message("all 8 photos")))
    assert line.startswith("the picture is a disc, as of a fisheye lens")
