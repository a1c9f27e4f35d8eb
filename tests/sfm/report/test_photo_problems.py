"""Photos that are blurred, too dark or too bright."""

import numpy as np
import pytest
from PIL import Image, ImageFilter

from snowsplat.sfm.report.photo_problems import problems, problems_of


@pytest.fixture
def sharp() -> Image.Image:
    """Detail at all scales, as in real photos."""
    random = np.random.default_rng(0)
    total = np.zeros((480, 640))
    for size in (5, 10, 20, 40, 80, 160, 320):
        layer = Image.fromarray(random.normal(size=(size * 3 // 4, size)).astype(np.float32))
        total += np.asarray(layer.resize((640, 480), Image.Resampling.BICUBIC))
    total += random.normal(size=total.shape)
    return Image.fromarray((128 + 18 * total).clip(0, 255).astype(np.uint8))


def moved(image: Image.Image, pixels: int) -> Image.Image:
    """The image after a horizontal motion during the exposure."""
    shifted = [np.roll(np.asarray(image, np.float32), i, axis=1) for i in range(pixels)]
    return Image.fromarray(np.mean(shifted, axis=0).astype(np.uint8))


def test_blur(sharp):
    blurred = sharp.filter(ImageFilter.GaussianBlur(2))
    photos = [sharp, sharp, blurred, sharp, sharp, moved(sharp, 30), sharp, sharp, sharp]
    found = problems_of(map(np.asarray, photos))
    assert [i for i, problem in enumerate(found) if problem == "blurred"] == [2, 5]
    assert problems_of([np.asarray(blurred)]) == ["blurred"]  # with nothing to compare


def test_what_is_smooth_is_not_blurred(sharp):
    """Photos of skin or of a white table have little detail, and so have those beside them."""
    smooth = np.asarray(sharp.filter(ImageFilter.GaussianBlur(2)))
    detailed = np.asarray(sharp)
    assert problems_of([smooth] * 6) == [None] * 6
    assert problems_of([detailed] * 20 + [smooth] * 8) == [None] * 28


def test_exposure(sharp):
    pixels = np.asarray(sharp)
    bright = np.minimum(pixels * 2.2, 255).astype(np.uint8)
    assert problems_of([pixels // 4, bright, pixels]) == ["dark", "bright", None]


def test_a_folder(sharp, tmp_path):
    Image.merge("RGB", [sharp] * 3).save(tmp_path / "good.jpg")
    sharp.point(lambda value: value // 5).save(tmp_path / "dark.png")
    assert problems(tmp_path, ["good.jpg", "dark.png", "missing.jpg"]) == {"dark.png": "dark"}
