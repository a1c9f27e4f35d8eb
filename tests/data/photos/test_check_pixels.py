"""Damaged data of images in all formats, and JPEG files of all kinds that are not damaged."""

import io

import numpy as np
import pytest
from PIL import Image

from snowsplat.data.photos.check_pixels import check_pixels
from snowsplat.data.photos.image_file import check_jpeg
from snowsplat.util.errors import UserError

from ...sfm.pictures import photo

FORMATS = {
    "jpg": {}, "prog.jpg": {"progressive": True}, "rst.jpg": {"restart_marker_rows": 1},
    "png": {}, "webp": {"lossless": True}, "tif": {"compression": "tiff_adobe_deflate"},
    "lzw.tif": {"compression": "tiff_lzw"},
}  # fmt: skip


@pytest.mark.parametrize("suffix", FORMATS)
def test_damage_in_the_middle(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    photo(width=320, height=240).save(path, **FORMATS[suffix])
    check_pixels(path)
    data = path.read_bytes()
    middle = 60 if suffix == "webp" else len(data) // 2  # further on, all codes are valid
    path.write_bytes(data[:middle] + bytes(512) + data[middle + 512 :])
    with pytest.raises(UserError, match=rf"a.{suffix}: cannot be decoded .*; replace the file"):
        check_pixels(path)


def jpeg(image: Image.Image, **options) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG", **options)
    return file.getvalue()


IMAGE = photo(width=61, height=47)
VALID = {
    "grey": jpeg(IMAGE.convert("L")),
    "CMYK": jpeg(IMAGE.convert("CMYK")),
    "RGB": jpeg(IMAGE, keep_rgb=True),
    "no subsampling": jpeg(IMAGE, quality=100, subsampling=0),
    "worst quality": jpeg(IMAGE, quality=1, optimize=True),
    "restarts": jpeg(IMAGE, restart_marker_blocks=3),
    "one pixel": jpeg(IMAGE.resize((1, 1))),
    "small, progressive": jpeg(IMAGE.resize((17, 9)), progressive=True),
    "black": jpeg(Image.new("RGB", (300, 200))),
    "bytes after it": jpeg(IMAGE) + bytes(99),
    "a thumbnail": jpeg(IMAGE, exif=b"Exif\0\0" + jpeg(IMAGE.resize((30, 20)))),
    "faulty metadata": jpeg(IMAGE, comment=b"\xff\xd9"),
}


@pytest.mark.parametrize("kind", VALID)
def test_what_is_not_damaged(tmp_path, kind):
    (tmp_path / "a.jpg").write_bytes(VALID[kind])
    check_pixels(tmp_path / "a.jpg")


def test_photos_of_several_pictures(tmp_path):
    IMAGE.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[IMAGE.rotate(3)])
    check_pixels(tmp_path / "a.jpg")


def test_kinds_that_ffmpeg_does_not_know_are_not_judged_by_it(tmp_path):
    """Here the start of the frame says that its codes are arithmetic."""
    (tmp_path / "a.jpg").write_bytes(VALID["grey"].replace(b"\xff\xc0", b"\xff\xc9"))
    check_jpeg(tmp_path / "a.jpg")


def test_the_end_is_missing(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    (tmp_path / "a.jpg").write_bytes(jpeg(Image.fromarray(pixels))[:-900])
    with pytest.raises(UserError, match="cannot be decoded"):
        check_pixels(tmp_path / "a.jpg")
