"""Masks have the orientation and the size of their photos in input/."""

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.photos.exif import ExifInfo
from snowsplat.sfm.ingest.photos.mask_files import read_mask, shrink_mask, write_mask
from snowsplat.sfm.ingest.photos.photo_files import Header
from snowsplat.util.errors import UserError

from ...pictures import exif


def header(width, height, orientation=1):
    return Header("JPEG", width, height, True, False, ExifInfo(orientation))


def corner(width=60, height=40):
    """(height, width) uint8: only the upper left corner is set."""
    mask = np.zeros((height, width), np.uint8)
    mask[:10, :20] = 255
    return mask


@pytest.mark.parametrize("mode", ["1", "L", "RGB", "RGBA", "P"])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_any_image_format_and_mode(ending, mode, tmp_path):
    Image.fromarray(corner()).convert(mode).save(tmp_path / f"m.{ending}")
    counts = read_mask(tmp_path / f"m.{ending}", header(60, 40), (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_transparent_pixels_are_masked_out(tmp_path):
    image = Image.new("RGBA", (60, 40), "white")
    image.putalpha(Image.fromarray(corner()))
    image.save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png", header(60, 40), (60, 40)), corner() > 0)


@pytest.mark.parametrize("orientation", ["as stored", "upright", "exif"])
def test_a_mask_is_rotated_like_its_photo(orientation, tmp_path):
    stored = header(40, 60, orientation=6)
    mask = Image.fromarray(corner())  # upright
    if orientation != "upright":
        mask = mask.transpose(Image.Transpose.ROTATE_90)
    mask.save(tmp_path / "m.png", exif=exif({0x0112: 6 if orientation == "exif" else 1}))
    counts = read_mask(tmp_path / "m.png", stored, (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_a_rotation_by_180_degrees_is_taken_as_stored(tmp_path):
    Image.fromarray(corner()[::-1, ::-1]).save(tmp_path / "m.png")
    counts = read_mask(tmp_path / "m.png", header(60, 40, orientation=3), (60, 40))
    assert np.array_equal(counts, corner() > 0)


def test_a_pixel_of_a_smaller_mask_is_set_if_all_covered_pixels_are():
    counts = np.ones((40, 60), bool)
    counts[0, 0] = False
    small = shrink_mask(counts, (30, 20))
    assert not small[0, 0]
    assert small.sum() == 599
    odd = shrink_mask(counts, (23, 17))
    assert (odd.shape, odd[0, 0], odd[5:, 5:].all()) == ((17, 23), False, True)


def test_wrong_size_and_not_an_image(tmp_path):
    Image.new("L", (30, 25)).save(tmp_path / "m.png")
    with pytest.raises(UserError, match=r"m.png: the mask is 30x25, but its photo is 40x60; make"):
        read_mask(tmp_path / "m.png", header(60, 40, orientation=8), (40, 60))
    (tmp_path / "m.png").write_text("no image")
    with pytest.raises(UserError, match=r"m.png: the mask cannot be decoded"):
        read_mask(tmp_path / "m.png", header(60, 40), (60, 40))


def test_masks_are_written_as_grey_of_0_and_255(tmp_path):
    write_mask(tmp_path / "sub" / "a.jpg.png", corner() > 0)
    with Image.open(tmp_path / "sub" / "a.jpg.png") as image:
        assert image.mode == "L"
        assert np.array_equal(np.asarray(image), corner())
