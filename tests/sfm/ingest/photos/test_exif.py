"""Focal length and camera from EXIF data, and implausible values."""

import pycolmap
import pytest
from PIL import Image

from snowsplat.sfm.ingest.photos.exif import ExifInfo, exif_for_copy, read_exif

from ...pictures import exif, photo

GPS = {1: "S", 2: (33.0, 51.0, 24.5), 3: "E", 4: (151.0, 12.0, 0.0), 5: b"\x00", 6: 12.5}


@pytest.mark.parametrize("size", [(4000, 3000), (3000, 4000), (4000, 2250), (3000, 3000)])
def test_the_35_mm_equivalent_is_converted_as_colmap_does(size, tmp_path):
    data = exif(details={0xA405: 26})
    Image.new("RGB", size, "grey").save(tmp_path / "a.jpg", exif=data)
    theirs = pycolmap.Bitmap.read(str(tmp_path / "a.jpg"), True).exif_focal_length()
    assert read_exif(data, *size).focal == pytest.approx(theirs, rel=1e-3)


def test_focal_length_over_the_size_of_a_pixel():
    details = {0x920A: 50.0, 0xA20E: 5000.0, 0xA210: 2, 0xA002: 6000, 0xA003: 4000}
    assert read_exif(exif(details=details), 6000, 4000).focal == pytest.approx(50 * 5000 / 25.4)
    # The photo was resized by a program that did not change its EXIF data.
    assert read_exif(exif(details=details), 1500, 1000).focal == pytest.approx(50 * 1250 / 25.4)
    centimetres = details | {0xA210: 3}
    assert read_exif(exif(details=centimetres), 1500, 1000).focal == pytest.approx(6250)


def test_a_cropped_photo_has_the_focal_length_of_the_whole():
    """What is left is the largest part of its shape."""
    original = {0xA002: 6000, 0xA003: 3376, 0xA405: 24}
    whole = read_exif(exif(details=original), 6000, 3376)
    assert not whole.cropped
    for size, scale in (((3376, 3376), 1), ((6000, 3000), 1), ((1688, 1688), 0.5)):
        found = read_exif(exif(details=original), *size)
        assert found.focal == pytest.approx(scale * whole.focal)
        assert found.cropped
    # Upright, and half as large: not cropped.
    half = read_exif(exif(details=original), 1688, 3000)
    assert (half.focal, half.cropped) == (pytest.approx(0.5 * whole.focal), False)
    # Stitched of several.
    assert read_exif(exif(details=original), 12000, 3376).focal is None


def test_a_cropped_photo_and_the_size_of_a_pixel():
    details = {0x920A: 50.0, 0xA20E: 5000.0, 0xA210: 2, 0xA002: 6000, 0xA003: 4000}
    assert read_exif(exif(details=details), 1000, 1000).focal == pytest.approx(50 * 1250 / 25.4)


@pytest.mark.parametrize(
    "details",
    [
        {},
        {0x920A: 4.2},  # the sensor size is unknown
        {0xA405: 0},
        {0xA405: 65535},
        {0x920A: 50.0, 0xA20E: 0.0, 0xA210: 2},
        {0x920A: 50.0, 0xA20E: 5000.0, 0xA210: 99},
        {0xA405: "wide"},
    ],
)
def test_unusable_focal_lengths(details):
    assert read_exif(exif(details=details), 4000, 3000).focal is None


def test_missing_data_and_an_invalid_orientation():
    assert read_exif(Image.Exif(), 10, 10) == ExifInfo()
    assert read_exif(exif({0x0112: 77}), 10, 10).orientation == 1
    assert read_exif(exif({0x0112: 6}), 10, 10).orientation == 6


def test_camera_and_zoom_identify_a_group():
    def camera(**details):
        data = exif(
            {0x010F: "Maker\0 ", 0x0110: "M1"}, {int(k[1:], 16): v for k, v in details.items()}
        )
        return read_exif(data, 4000, 3000).camera

    assert camera(x920A=4.2, xA405=26) == "Maker M1 4.2 mm 26 mm"
    assert camera(x920A=4.2, xA405=26) != camera(x920A=2.2, xA405=13)


def test_a_copy_keeps_the_metadata_but_is_upright(tmp_path):
    details = {0xA405: 26, 0x927C: b"x" * 70000, 0xA20E: 5000.0, 0xA210: 2, 0x920A: 4.25}
    data = exif({0x0112: 6, 0x0110: "M1"}, details, GPS)
    photo().save(tmp_path / "a.jpg", exif=exif_for_copy(data, 320, 240))
    with Image.open(tmp_path / "a.jpg") as copy:
        found = copy.getexif()
        assert found[0x0112] == 1
        assert found[0x0110] == "M1"
        kept = found.get_ifd(0x8769)
        assert kept[0xA405] == 26
        assert 0x927C not in kept
        assert 0xA20E not in kept
        assert (kept[0xA002], kept[0xA003]) == (320, 240)
        assert read_exif(found, 320, 240).location == read_exif(data, 320, 240).location
