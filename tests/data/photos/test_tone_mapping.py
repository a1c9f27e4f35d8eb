"""HEIC and AVIF photos of high dynamic range get the tones that HDR films get."""

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from snowsplat.data.photos.colour_profile import plain_pixels
from snowsplat.data.photos.tone_mapping import HLG, PQ, map_tones
from snowsplat.sfm.ingest.photos.photo_files import decode, read_header

SIDE = 64


def signal() -> np.ndarray:
    """(SIDE, SIDE, 3) uint16, smooth."""
    x, y = np.meshgrid(np.linspace(0.1, 0.7, SIDE), np.linspace(0.2, 0.6, SIDE))
    return np.rint(np.stack([x, y, (x + y) / 2], -1) * 65535).astype(np.uint16)


def heic(path, transfer, primaries=9):
    """10 bits, BT.2020."""
    image = pillow_heif.from_bytes("RGB;16", (SIDE, SIDE), signal().tobytes())
    image.save(
        path,
        quality=-1,
        chroma=444,
        color_primaries=primaries,
        transfer_characteristics=transfer,
        matrix_coefficients=9,
        full_range_flag=1,
    )


def avif(path, transfer, primaries=9):
    """8 bits, whose colours are described as others than Pillow writes."""
    Image.fromarray((signal() >> 8).astype(np.uint8)).save(path, quality=100, subsampling="4:4:4")
    head, box, rest = path.read_bytes().partition(b"colrnclx")
    colours = primaries.to_bytes(2, "big") + transfer.to_bytes(2, "big")
    path.write_bytes(head + box + colours + rest[4:])


@pytest.mark.parametrize("write", [heic, avif])
@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_the_tones_are_those_of_a_film(tmp_path, write, transfer):
    path = tmp_path / f"a.{write.__name__}"
    write(path, transfer)
    found = np.asarray(decode(path, read_header(path), None)).astype(int)
    expected = map_tones(signal(), transfer).astype(int)
    assert np.abs(found - expected).mean() < 3
    assert (
        np.abs(np.asarray(Image.fromarray((signal() >> 8).astype(np.uint8))) - expected).mean() > 8
    )


def test_standard_range_stays(tmp_path):
    path = tmp_path / "a.avif"
    Image.fromarray((signal() >> 8).astype(np.uint8)).save(path, quality=90)
    with Image.open(path) as image:
        assert plain_pixels(image, path) is image or image.mode == "RGB"
        found = np.asarray(plain_pixels(image, path)).astype(int)
    assert np.abs(found - (signal() >> 8)).mean() < 4


def test_other_primaries():
    """A wider gamut has less of green in what it calls red; grey stays grey."""
    grey = np.full((1, 1, 3), 30000, np.uint16)
    assert np.ptp(map_tones(grey, PQ, 12).astype(int)) <= 1
    red = np.array([[[30000, 26000, 26000]]], np.uint16)
    green = [int(map_tones(red, PQ, primaries)[0, 0, 1]) for primaries in (9, 12, 1)]
    assert green[0] < green[1] < green[2]
