"""Photo files of any format become upright pixels in a format that COLMAP reads."""

import numpy as np
import pillow_heif
import pycolmap
import pytest
from PIL import Image

from snowsplat.sfm.ingest.photos.photo_files import (
    Unusable,
    decode,
    decode_small,
    link_or_copy,
    read_header,
    save,
)
from snowsplat.util.image_size import scaled_size

from ...pictures import HEIGHT, WIDTH, exif, photo, wall


def stored(upright: Image.Image, orientation: int) -> Image.Image:
    """The pixels as a camera with that orientation stores them: the inverse of EXIF's rotation."""
    undo = {
        2: [Image.Transpose.FLIP_LEFT_RIGHT],
        3: [Image.Transpose.ROTATE_180],
        4: [Image.Transpose.FLIP_TOP_BOTTOM],
        5: [Image.Transpose.TRANSPOSE],
        6: [Image.Transpose.ROTATE_90],
        7: [Image.Transpose.TRANSVERSE],
        8: [Image.Transpose.ROTATE_270],
    }
    for step in undo.get(orientation, []):
        upright = upright.transpose(step)
    return upright


def difference(a, b) -> float:
    return float(np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ending", "orientation"),
    [*(("jpg", i) for i in range(1, 9)), ("png", 1), ("png", 6), ("tif", 6), ("webp", 1)],
)
def test_every_orientation_becomes_upright(ending, orientation, tmp_path):
    path = tmp_path / f"a.{ending}"
    stored(photo(), orientation).save(path, exif=exif({0x0112: orientation}), quality=95)
    header = read_header(path)
    assert header.size(None) == (WIDTH, HEIGHT)
    assert header.is_ready(None) == (orientation == 1 and ending != "webp")
    image = decode(path, header, None)
    assert (image.size, image.mode) == ((WIDTH, HEIGHT), "RGB")
    assert difference(image, wall()) < 12

    name = header.file_name(path.name, None)
    copy = tmp_path / "new" / name
    copy.parent.mkdir()
    save(image, copy, path)
    assert read_header(copy).is_ready(None)
    seen = pycolmap.Bitmap.read(str(copy), True).to_array()
    assert difference(seen, wall()) < 12


def test_colmap_ignores_the_exif_orientation(tmp_path):
    """If COLMAP applied it, pixels that are already upright would be rotated."""
    stored(photo(), 6).save(tmp_path / "a.jpg", exif=exif({0x0112: 6}))
    assert pycolmap.Bitmap.read(str(tmp_path / "a.jpg"), True).width == HEIGHT


def test_heic(tmp_path):
    pillow_heif.register_heif_opener()
    path = tmp_path / "IMG 1.HEIC"
    stored(photo(), 6).save(path, exif=exif({0x0112: 6}).tobytes(), quality=95)
    header = read_header(path)
    assert header.size(None) == (WIDTH, HEIGHT)
    assert not header.is_ready(None)
    assert header.file_name("sub/IMG 1.HEIC", None) == "sub/IMG 1.jpg"
    assert difference(decode(path, header, None), wall()) < 12


def test_names_keep_a_correct_extension(tmp_path):
    photo().save(tmp_path / "A.JPG", "JPEG")
    photo().save(tmp_path / "b.png", "JPEG")
    photo().save(tmp_path / "c.TIFF", "TIFF")
    assert read_header(tmp_path / "A.JPG").file_name("A.JPG", None) == "A.JPG"
    assert read_header(tmp_path / "b.png").file_name("b.png", None) == "b.jpg"
    assert read_header(tmp_path / "c.TIFF").file_name("c.TIFF", None) == "c.TIFF"
    assert read_header(tmp_path / "c.TIFF").file_name("c.TIFF", 200) == "c.png"


def test_cmyk(tmp_path):
    photo().convert("CMYK").save(tmp_path / "a.jpg", quality=95)
    header = read_header(tmp_path / "a.jpg")
    assert not header.is_ready(None)
    assert difference(decode(tmp_path / "a.jpg", header, None), wall()) < 12


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_16_bit_grey(ending, tmp_path):
    grey = wall()[..., 0].astype(np.uint16) * 256 + 77
    path = tmp_path / f"a.{ending}"
    Image.fromarray(grey).save(path)
    header = read_header(path)
    assert not header.is_ready(None)
    image = decode(path, header, None)
    assert image.mode == "L"
    assert np.array_equal(np.asarray(image), wall()[..., 0])
    assert header.file_name(path.name, None) == "a.png"


def test_16_bit_colour(tmp_path):
    import struct
    import zlib

    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    rows = (wall().astype(">u2") * 257).reshape(HEIGHT, -1)
    body = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 16, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(body)), chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    header = read_header(tmp_path / "a.png")
    assert not header.is_ready(None)
    assert np.array_equal(np.asarray(decode(tmp_path / "a.png", header, None)), wall())


def test_floating_point_is_rejected(tmp_path):
    Image.fromarray(np.zeros((100, 100), np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(Unusable, match="floating-point"):
        decode(tmp_path / "a.tif", read_header(tmp_path / "a.tif"), None)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparency_becomes_rgba(mode, tmp_path):
    alpha = Image.fromarray(np.where(np.arange(WIDTH) < 100, 0, 255).astype(np.uint8)[None])
    image = photo()
    image.putalpha(alpha.resize((WIDTH, HEIGHT), Image.Resampling.NEAREST))
    image.convert(mode).save(tmp_path / "a.png")
    header = read_header(tmp_path / "a.png")
    assert header.transparent
    assert header.is_ready(None) == (mode == "RGBA")
    assert header.file_name("a.png", None) == "a.png"
    got = np.asarray(decode(tmp_path / "a.png", header, None))
    assert got.shape == (HEIGHT, WIDTH, 4)
    assert (got[:, :100, 3] == 0).all()
    assert (got[:, 100:, 3] == 255).all()


def test_an_opaque_alpha_channel_is_removed(tmp_path):
    photo().convert("RGBA").save(tmp_path / "a.webp")
    header = read_header(tmp_path / "a.webp")
    assert decode(tmp_path / "a.webp", header, None).mode == "RGB"
    assert header.file_name("a.webp", None).startswith("a.")


def test_the_longest_side_is_limited():
    assert scaled_size(4000, 3000, 1600) == (1600, 1200)
    assert scaled_size(3000, 4000, 1600) == (1200, 1600)
    assert scaled_size(800, 600, 1600) == (800, 600)
    assert scaled_size(100_000, 20, 1600) == (1600, 1)


def test_a_jpeg_is_decoded_at_a_smaller_size_but_read_completely(tmp_path):
    photo().resize((3200, 2400)).save(tmp_path / "a.jpg", quality=90)
    image = decode_small(tmp_path / "a.jpg", 320)
    assert 640 <= image.width <= 1000
    content = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(Unusable, match="damaged"):
        decode_small(tmp_path / "a.jpg", 320)


def test_text_files_and_icons(tmp_path):
    (tmp_path / "a.jpg").write_text("not a photo")
    with pytest.raises(Unusable, match="not an image of a known format"):
        read_header(tmp_path / "a.jpg")
    Image.new("RGB", (16, 16)).save(tmp_path / "b.png")
    with pytest.raises(Unusable, match="has only 16x16 pixels"):
        read_header(tmp_path / "b.png")


def test_a_hard_link_if_possible(tmp_path):
    photo().save(tmp_path / "a.jpg")
    (tmp_path / "link.jpg").symlink_to(tmp_path / "a.jpg")
    link_or_copy(tmp_path / "link.jpg", tmp_path / "b.jpg")
    assert not (tmp_path / "b.jpg").is_symlink()
    assert (tmp_path / "b.jpg").samefile(tmp_path / "a.jpg")


def test_a_copy_if_links_are_not_supported(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr("os.link", refuse)
    photo().save(tmp_path / "a.jpg")
    link_or_copy(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert not (tmp_path / "b.jpg").samefile(tmp_path / "a.jpg")
    assert (tmp_path / "b.jpg").read_bytes() == (tmp_path / "a.jpg").read_bytes()


def test_exif_data_are_copied_but_no_colour_profile(tmp_path):
    """The colours of the copy are those of sRGB: see tests/data/test_colour_profile.py."""
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    stored(photo(), 6).save(
        tmp_path / "a.jpg", exif=exif({0x0112: 6, 0x0110: "M1"}), icc_profile=profile
    )
    header = read_header(tmp_path / "a.jpg")
    save(decode(tmp_path / "a.jpg", header, 160), tmp_path / "b.jpg", tmp_path / "a.jpg")
    with Image.open(tmp_path / "b.jpg") as copy:
        assert copy.size == (160, 120)
        assert "icc_profile" not in copy.info
        assert copy.getexif()[0x0110] == "M1"
        assert copy.layer[0][1:3] == (1, 1)  # 4:4:4
