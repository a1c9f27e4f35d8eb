"""Limits on image files from untrusted sources: at each limit a file is accepted, above it not."""

import os
import struct

import pytest
from PIL import Image
from PIL.ExifTags import Base
from PIL.PngImagePlugin import PngInfo
from pillow_heif import register_heif_opener

from snowsplat.data.photos import image_file
from snowsplat.data.photos.decode import ImageSource, load_image, read_header
from snowsplat.util.errors import UserError


def tiff_of_tiles(path, size, tile):
    """The header of a grey TIFF with one tile, whose pixels are missing."""
    entries = {
        256: size[0],  # width
        257: size[1],  # height
        258: 8,  # bits
        259: 1,  # not compressed
        262: 1,  # 0 is black
        277: 1,  # samples per pixel
        322: tile[0],  # width of a tile
        323: tile[1],  # height of a tile
        324: 8,  # offset
        325: tile[0] * tile[1],  # bytes
    }
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries.items())
    content = b"II*\0" + struct.pack("<IH", 8, len(entries)) + rows + bytes(4)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("size", "tile", "valid"),
    [
        ((40, 30), (2048, 2048), True),
        ((40, 30), (2048, 2064), False),
        ((40, 30), (16384, 256), True),
        ((40, 30), (256, 16384), True),
        ((40, 30), (8192, 1024), False),
        ((40, 30), (1024, 8192), False),
        ((4096, 2048), (4096, 2048), True),
        ((4096, 2048), (4096, 2064), False),
    ],
)
def test_tiles_of_a_tiff(tmp_path, size, tile, valid):
    path = tiff_of_tiles(tmp_path / "a.tif", size, tile)
    os.truncate(path, 1 << 28)  # the file has the tiles
    if valid:
        header = read_header(path)
        assert (header.width, header.height) == size
    else:
        with pytest.raises(UserError, match=r"decoded \(has tiles larger than the image\)"):
            read_header(path)


@pytest.mark.parametrize(("width", "height"), [(65_535, 1), (1, 65_535)])
def test_the_longest_side(tmp_path, width, height):
    path = tmp_path / "a.ppm"
    path.write_bytes(f"P5 {width} {height} 255\n".encode())
    assert read_header(path).width == width
    path.write_bytes(f"P5 {width + (width > 1)} {height + (height > 1)} 255\n".encode())
    with pytest.raises(UserError, match=r"decoded \(more than 178 million pixels, or 65,535 a"):
        read_header(path)


def test_the_largest_number_of_pixels(tmp_path, monkeypatch):
    path = tmp_path / "a.ppm"
    path.write_bytes(b"P5 40 30 255\n")
    monkeypatch.setattr(image_file, "MOST_PIXELS", 40 * 30)
    assert read_header(path).width == 40
    monkeypatch.setattr(image_file, "MOST_PIXELS", 40 * 30 - 1)
    with pytest.raises(UserError, match="cannot be decoded"):
        read_header(path)


def test_scans_of_a_jpeg(tmp_path, monkeypatch):
    """A progressive file of libjpeg has 10 scans. Markers inside of a comment are not scans."""
    path = tmp_path / "a.jpg"
    image = Image.linear_gradient("L").resize((40, 30)).convert("RGB")
    image.save(path, progressive=True, comment=b"\xff\xda\x00\x02" * 200)
    monkeypatch.setattr(image_file, "_MOST_SCANNED_PIXELS", 10 * 40 * 30)
    assert load_image(ImageSource(path, 40, 30)).shape == (3, 30, 40)
    monkeypatch.setattr(image_file, "_MOST_SCANNED_PIXELS", 10 * 40 * 30 - 1)
    with pytest.raises(UserError, match=r"decoded \(too many scans \(10\) for its size\)"):
        load_image(ImageSource(path, 40, 30))
    assert read_header(path).width == 40  # the pixels are not decoded


def test_segments_of_a_jpeg_and_chunks_of_a_png(tmp_path, monkeypatch):
    """A baseline JPEG has 9 segments: APP0, 2 DQT, SOF, 4 DHT and SOS. Its end is a marker too."""
    jpeg, png = tmp_path / "a.jpg", tmp_path / "a.png"
    image = Image.new("RGB", (4, 3))
    image.save(jpeg)
    texts = PngInfo()
    for number in range(8):
        texts.add_text("Comment", str(number))
    image.save(png, pnginfo=texts)  # 11 chunks: IHDR, the texts, IDAT and IEND
    monkeypatch.setattr(image_file, "_MOST_SEGMENTS", 11)
    for path in (jpeg, png):
        assert load_image(ImageSource(path, 4, 3)).shape == (3, 3, 4)
    monkeypatch.setattr(image_file, "_MOST_SEGMENTS", 10)
    assert load_image(ImageSource(jpeg, 4, 3)).shape == (3, 3, 4)
    with pytest.raises(UserError, match=r"a\.png: cannot be decoded \(too many chunks\)"):
        read_header(png)
    monkeypatch.setattr(image_file, "_MOST_SEGMENTS", 9)
    with pytest.raises(UserError, match=r"a\.jpg: cannot be decoded \(too many segments\)"):
        load_image(ImageSource(jpeg, 4, 3))


def test_bytes_before_the_pixels_of_a_jpeg(tmp_path, monkeypatch):
    path = tmp_path / "a.jpg"
    monkeypatch.setattr(image_file, "_LONGEST_HEADER", 3000)
    image = Image.effect_noise((200, 200), 60)
    image.save(path, quality=95)
    assert path.stat().st_size > 3000  # pixels do not count
    assert read_header(path).width == 200
    image.save(path, comment=bytes(3000))
    with pytest.raises(UserError, match=r"decoded \(too many bytes before its pixels\)"):
        read_header(path)


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".avif"])
def test_a_photo_beyond_the_limit_is_decoded_at_half_its_size(tmp_path, monkeypatch, suffix):
    """As phones take with 200 million pixels; other formats are refused."""
    monkeypatch.setattr(image_file, "MOST_PIXELS", 3000)
    most = dict.fromkeys(("JPEG", "HEIF", "AVIF"), 97 * 65)
    monkeypatch.setattr(image_file, "_MOST_PIXELS", most)
    photo = Image.new("RGB", (97, 65), (200, 30, 30))
    register_heif_opener()
    exif = Image.Exif()
    exif[Base.Make] = "a maker"
    for name in ("a.png", f"a{suffix}"):
        photo.save(tmp_path / name, exif=exif)
    for header_only in (False, True):
        with image_file.open_image(
            tmp_path / f"a{suffix}", ("JPEG", "HEIF", "AVIF"), header_only=header_only
        ) as image:
            assert image.size == (49, 33)
            assert image.getexif()[Base.Make] == "a maker"
            if not header_only:
                assert image.format == {".heic": "HEIF"}.get(suffix, Image.EXTENSION[suffix])
                assert image.convert("RGB").getpixel((3, 3))[0] > 150
    photo.resize((98, 65)).save(tmp_path / f"b{suffix}")
    for name in ("a.png", f"b{suffix}"):
        with pytest.raises(ValueError, match="million pixels"):
            image_file.open_image(tmp_path / name, ("JPEG", "PNG", "HEIF", "AVIF"))


def test_large_photos_of_phones_are_within_the_limits():
    for format in ("JPEG", "MPO", "HEIF", "AVIF"):
        assert image_file._MOST_PIXELS[format] >= 16_320 * 12_240
    assert image_file._MOST_PIXELS["HEIF"] < 1.2 * image_file.MOST_PIXELS
