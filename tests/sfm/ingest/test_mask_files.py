"""Masks lie on their photos as they are in input/."""

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.exif import Notes
from snowsplat.sfm.ingest.mask_files import read_mask, shrunk, write_mask
from snowsplat.sfm.ingest.photo_files import Header
from snowsplat.util.errors import UserError

from ..pictures import exif


def header(width, height, orientation=1):
    return Header("JPEG", width, height, True, False, Notes(orientation))


def corner(width=60, height=40):
    """(height, width) uint8: only the upper left corner counts."""
    mask = np.zeros((height, width), np.uint8)
    mask[:10, :20] = 255
    return mask


@pytest.mark.parametrize("mode", ["1", "L", "RGB", "RGBA", "P"])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_any_image_will_do(ending, mode, tmp_path):
    Image.fromarray(corner()).convert(mode).save(tmp_path / f"m.{ending}")
    counts = read_mask(tmp_path / f"m.{ending}", header(60, 40), (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_transparent_does_not_count(tmp_path):
    image = Image.new("RGBA", (60, 40), "white")
    image.putalpha(Image.fromarray(corner()))
    image.save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png", header(60, 40), (60, 40)), corner() > 0)


@pytest.mark.parametrize("lies", ["as stored", "upright", "noted"])
def test_turned_as_its_photo(lies, tmp_path):
    stored = header(40, 60, orientation=6)
    mask = Image.fromarray(corner())  # upright
    if lies != "upright":
        mask = mask.transpose(Image.Transpose.ROTATE_90)
    mask.save(tmp_path / "m.png", exif=exif({0x0112: 6 if lies == "noted" else 1}))
    counts = read_mask(tmp_path / "m.png", stored, (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_upside_down_is_taken_as_stored(tmp_path):
    Image.fromarray(corner()[::-1, ::-1]).save(tmp_path / "m.png")
    counts = read_mask(tmp_path / "m.png", header(60, 40, orientation=3), (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_shrunk_pixels_count_where_all_that_they_cover_does():
    counts = np.ones((40, 60), bool)
    counts[0, 0] = False
    small = shrunk(counts, (30, 20))
    assert not small[0, 0]
    assert small.sum() == 599
    odd = shrunk(counts, (23, 17))
    assert (odd.shape, odd[0, 0], odd[5:, 5:].all()) == ((17, 23), False, True)


def test_wrong_size_and_no_image(tmp_path):
    Image.new("L", (30, 20)).save(tmp_path / "m.png")
    with pytest.raises(UserError, match=r"m.png: the mask is 30x20, but its photo is 40x60; make"):
        read_mask(tmp_path / "m.png", header(60, 40, orientation=8), (40, 60))
    (tmp_path / "m.png").write_text("no image")
    with pytest.raises(UserError, match=r"m.png: the mask cannot be decoded"):
        read_mask(tmp_path / "m.png", header(60, 40), (60, 40))


def test_written_as_grey_of_0_and_255(tmp_path):
    write_mask(tmp_path / "sub" / "a.jpg.png", corner() > 0)
    with Image.open(tmp_path / "sub" / "a.jpg.png") as image:
        assert image.mode == "L"
        assert np.array_equal(np.asarray(image), corner())
