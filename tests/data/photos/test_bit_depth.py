"""Photos of 16 bits whose values have fewer: one scale for all photos of a folder."""

import logging

import cv2
import numpy as np
import pytest
from PIL import Image

from snowsplat.data.photos.decode import ImageSource, load_image
from snowsplat.sfm.ingest.photos.photo_files import decode, read_header

HEIGHT, WIDTH = 120, 160


def write(folder, brightest, channels, ending="png", count=3, darkest=0) -> list[np.ndarray]:
    """Photos with random values; the first is half as bright."""
    folder.mkdir(exist_ok=True)
    generator = np.random.default_rng(0)
    photos = []
    for i in range(count):
        top = brightest if i else (brightest + darkest) // 2
        values = generator.integers(darkest, top + 1, (HEIGHT, WIDTH, channels)).astype(np.uint16)
        photos.append(values)
        cv2.imwrite(str(folder / f"{i}.{ending}"), values[..., ::-1])
    return photos


def read(path) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) in training and in structure from motion."""
    planes = load_image(ImageSource(path, WIDTH, HEIGHT)).permute(1, 2, 0).numpy()
    return planes, np.asarray(decode(path, read_header(path), None).convert("RGB"))


@pytest.mark.parametrize("ending", ["png", "tif"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("bits", [10, 12, 16])
def test_every_photo_has_the_scale_of_its_folder(tmp_path, caplog, ending, channels, bits):
    white = (1 << bits) - 1
    photos = write(tmp_path, white, channels, ending)
    (tmp_path / f"damaged.{ending}").write_bytes(b"II*\0")
    cv2.imwrite(str(tmp_path / f"eight.{ending}"), np.full((40, 40), 250, np.uint8))
    with caplog.at_level(logging.INFO, "snowsplat"):
        for i, values in enumerate(photos):
            for got in read(tmp_path / f"{i}.{ending}"):
                assert np.abs(got - 255 * (values / white)).max() < 1.01
    lines = [record.getMessage() for record in caplog.records]
    scaled = f"the photos use {bits} of 16 bits; all of them are scaled by {1 << (16 - bits)}"
    assert (len(lines), scaled in "".join(lines)) == ((0, False) if bits == 16 else (1, True))


def test_a_narrow_range_is_shown_from_black_to_white(tmp_path, caplog):
    """Thermal cameras: hundredths of a kelvin, with a broken pixel."""
    photos = write(tmp_path, 31_000, 1, darkest=29_000)
    photos[1][3, 4] = 0
    Image.fromarray(photos[1][..., 0]).save(tmp_path / "1.png")
    with caplog.at_level(logging.INFO, "snowsplat"):
        for i, values in enumerate(photos):
            expected = np.clip((values / 1.0 - 29_000) / 2000, 0, 1) * 255
            for got in read(tmp_path / f"{i}.png"):
                assert np.abs(got - expected).max() < 2
    assert "values from 29,0" in caplog.text


def test_a_folder_is_read_again_when_photos_are_added(tmp_path):
    write(tmp_path, 4095, 1)
    assert read(tmp_path / "2.png")[0].max() == 255
    new = np.full((HEIGHT, WIDTH), 60_000, np.uint16)
    Image.fromarray(new).save(tmp_path / "3.png")
    assert read(tmp_path / "2.png")[0].max() == 15


def test_a_black_folder(tmp_path):
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(tmp_path / "a.png")
    assert read(tmp_path / "a.png")[0].max() == 0
