"""360° panoramas are recognised, and ordinary photos twice as wide as high are none."""

import struct

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from snowsplat.sfm.ingest.content.panorama import (
    NOT_TWICE_AS_WIDE,
    STITCHED,
    Panorama,
    panorama_in_xmp,
    shows_all_around,
    spherical_video,
)
from snowsplat.sfm.ingest.photo import not_used
from snowsplat.util.errors import UserError

from ...pictures import gathered, pan, photo, wall, write_photos, write_video

_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description '
    b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" %s/></x:xmpmeta>'
)
_WHOLE = _XMP % b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4096"'
_PART = _XMP % (
    b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4096" '
    b'GPano:CroppedAreaImageWidthPixels="1800"'
)


def _with_rows(rows: int, whole: int, top: int) -> bytes:
    return _XMP % (
        b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="1024" '
        b'GPano:FullPanoHeightPixels="%d" GPano:CroppedAreaImageWidthPixels="1024" '
        b'GPano:CroppedAreaImageHeightPixels="%d" GPano:CroppedAreaTopPixels="%d"'
        % (whole, rows, top)
    )


_CROPPED = _with_rows(400, 512, 40)


def _as_png(xmp: bytes) -> PngImagePlugin.PngInfo:
    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp.decode())
    return info


def panorama(seed=0, width=512, noise=2.0) -> np.ndarray:
    """(H, W, 3) uint8: a random smooth function of the direction, with detail."""
    height, random = width // 2, np.random.default_rng(seed)
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    x = np.cos(latitude)[:, None] * np.sin(longitude)
    y = np.repeat(np.sin(latitude)[:, None], width, axis=1)
    z = np.cos(latitude)[:, None] * np.cos(longitude)
    direction = np.stack([x, y, z], axis=-1)
    value = np.zeros((height, width, 3))
    for frequency in (1, 2, 4, 8, 16):
        phase = direction @ random.normal(0, frequency * 2, (3, 3)) + random.uniform(0, 6, 3)
        value += np.sin(phase) / np.sqrt(frequency)
    picture = 128 + 45 * value + random.normal(0, noise, value.shape)
    return np.clip(picture, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_pixels_of_a_panorama(seed):
    assert shows_all_around(Image.fromarray(panorama(seed)))


@pytest.mark.parametrize("seed", range(3))
def test_a_part_of_a_panorama_is_an_ordinary_photo(seed):
    whole = panorama(seed, width=1024)
    part = Image.fromarray(whole[100:400, 200:800])
    assert not shows_all_around(part)
    assert not shows_all_around(Image.fromarray(np.roll(whole, 100, axis=0)))


def test_ordinary_photos_twice_as_wide_as_high():
    for seed in range(4):
        picture = wall(seed=seed, width=512, height=256)
        assert not shows_all_around(Image.fromarray(picture))
        framed = picture.copy()
        framed[:30] = framed[-30:] = 0
        framed[:, :30] = framed[:, -30:] = 0
        assert not shows_all_around(Image.fromarray(framed))
        sky_and_road = picture.copy()
        sky_and_road[:60], sky_and_road[-60:] = 200, 90
        assert not shows_all_around(Image.fromarray(sky_and_road))


def test_metadata_of_panoramas():
    assert panorama_in_xmp(_WHOLE, 4096, 2048) == Panorama()
    assert panorama_in_xmp(_WHOLE, 512, 256) == Panorama()
    assert panorama_in_xmp(_WHOLE, 4096, 1000) == STITCHED
    assert panorama_in_xmp(_PART, 1800, 900) == STITCHED
    element = b"<GPano:ProjectionType>cylindrical</GPano:ProjectionType>"
    assert panorama_in_xmp(element, 4096, 2048) == STITCHED
    assert panorama_in_xmp(_XMP % b'GPano:UsePanoramaViewer="False"', 4096, 2048) is None
    assert panorama_in_xmp(b"", 4096, 2048) is None


def test_missing_rows_are_known_from_the_metadata():
    found = panorama_in_xmp(_CROPPED, 1024, 400)
    assert found.rows(400) == (40, 72)
    assert panorama_in_xmp(_CROPPED, 512, 200).rows(200) == (20, 36)
    assert panorama_in_xmp(_CROPPED, 512, 240) == STITCHED  # another part than the metadata say
    for numbers in ((0, 512, 0), (400, 0, 0), (400, 512, 200), (999999999, 1, 999999999)):
        xmp = _with_rows(*numbers)
        assert panorama_in_xmp(xmp, 1024, 400) == STITCHED


def with_box(path, *boxes):
    path.write_bytes(b"".join(struct.pack(">I4s", 8 + len(c), kind) + c for kind, c in boxes))
    return path


def test_metadata_of_spherical_videos(tmp_path):
    first = b"<GSpherical:Spherical>true</GSpherical:Spherical>"
    second = b"....sv3d....svhd........proj....prhd............equi" + bytes(20)
    head, data = (b"ftyp", b"isom" * 4), (b"mdat", first * 3)

    def found(name, *boxes):
        return spherical_video(with_box(tmp_path / name, *boxes))

    assert found("a.mp4", head, data, (b"moov", first)) == ""
    assert found("b.mp4", head, (b"moov", second)) == ""
    assert found("c.mp4", head, data, (b"moov", b"trak" * 9)) is None
    assert found("d.mp4", head, data) is None
    assert spherical_video(write_video(tmp_path / "e.mp4", pan(3))) is None
    # Two pictures, the half in front of the camera, a cube.
    two = first + b"<GSpherical:StereoMode>top-bottom</GSpherical:StereoMode>"
    assert "two eyes" in found("f.mp4", head, (b"moov", two))
    assert "two eyes" in found("g.mp4", head, (b"moov", b"st3d\0\0\0\0\1" + second))
    assert found("h.mp4", head, (b"moov", b"st3d\0\0\0\0\0" + second)) == ""
    half = second[:-8] + b"\x40\0\0\0" * 2
    assert "a part" in found("i.mp4", head, (b"moov", half))
    assert "cube" in found("j.mp4", head, (b"moov", b"sv3d....cbmp" + bytes(20)))


@pytest.mark.parametrize("xmp", [_WHOLE, None])
def test_panoramas_are_recognised(tmp_path, xmp):
    (tmp_path / "p").mkdir()
    for i in range(4):
        options = {"xmp": xmp} if xmp else {}
        Image.fromarray(panorama(i)).save(tmp_path / "p" / f"{i}.jpg", quality=95, **options)
    made = gathered(tmp_path / "p", tmp_path / "out")
    assert [(photo.name, photo.panorama) for photo in made.photos] == [
        (f"{i}.jpg", True) for i in range(4)
    ]
    assert len({photo.group for photo in made.photos}) == 1
    assert not made.left_out


def test_missing_rows_are_black_and_masked(tmp_path):
    (tmp_path / "p").mkdir()
    for i in range(3):
        part = panorama(i)[20:220]
        Image.fromarray(part).save(tmp_path / "p" / f"{i}.png", pnginfo=_as_png(_CROPPED))
    made = gathered(tmp_path / "p", tmp_path / "out")
    assert all(
        (p.width, p.height, p.panorama, p.mask) == (512, 256, True, True) for p in made.photos
    )
    pixels = np.asarray(Image.open(tmp_path / "out" / "input" / "1.png"))
    assert np.array_equal(pixels[20:220], panorama(1)[20:220])
    assert not np.delete(pixels, np.s_[20:220], axis=0).any()
    used = np.asarray(Image.open(tmp_path / "out" / "distorted" / "masks" / "1.png.png")) > 0
    assert used[20:220].all()
    assert not np.delete(used, np.s_[20:220], axis=0).any()


def test_a_panorama_among_photos_has_a_camera_of_its_own(tmp_path):
    source = write_photos(tmp_path / "p", 4)
    Image.fromarray(panorama(60)).save(source / "pano.jpg", quality=95, xmp=_WHOLE)
    made = gathered(source, tmp_path / "out")
    assert [photo.panorama for photo in made.photos] == [False] * 4 + [True]
    assert made.photos[-1].group != made.photos[0].group


def test_panoramas_with_an_edge_at_a_pole_are_recognised_by_the_others(tmp_path):
    (tmp_path / "p").mkdir()
    for i in range(6):
        picture = panorama(i)
        if i < 2:
            picture[:4] = np.where(np.arange(512) % 256 < 128, 20, 220)[:, None]
            assert not shows_all_around(Image.fromarray(picture))
        Image.fromarray(picture).save(tmp_path / "p" / f"{i}.jpg", quality=95)
    made = gathered(tmp_path / "p", tmp_path / "out")
    assert [photo.panorama for photo in made.photos] == [True] * 6
    assert len({photo.group for photo in made.photos}) == 1


def test_photos_are_panoramas_if_the_user_says_so(tmp_path):
    source = tmp_path / "p"
    source.mkdir()
    for i in range(3):
        Image.fromarray(wall(seed=i, width=512, height=256)).save(source / f"{i}.png")
    photo(5).save(source / "flat.png")
    made = gathered(source, tmp_path / "out", panoramas=True)
    assert [photo.panorama for photo in made.photos] == [True] * 3
    assert made.left_out == [not_used(source / "flat.png", NOT_TWICE_AS_WIDE)]


def test_stitched_panoramas_are_refused_by_name(tmp_path):
    (tmp_path / "p").mkdir()
    for i in range(4):
        photo(i).save(tmp_path / "p" / f"{i}.jpg", quality=95, xmp=_PART)
    with pytest.raises(UserError, match="all 4 images are stitched panoramas") as error:
        gathered(tmp_path / "p", tmp_path / "out")
    assert "\n" not in str(error.value)


def test_the_frames_of_a_360_video_are_panoramas(tmp_path):
    frames = [np.roll(panorama(1), 9 * i, axis=1) for i in range(10)]
    made = gathered(write_video(tmp_path / "v.mp4", frames), tmp_path / "out")
    assert len(made.photos) >= 3
    assert all(photo.panorama and photo.sequence for photo in made.photos)


def test_a_video_of_two_eyes_is_refused_by_name(tmp_path):
    path = write_video(tmp_path / "v.mp4", pan(3))
    spherical = b"<GSpherical:Spherical>true<GSpherical:StereoMode>top-bottom"
    content = path.read_bytes()
    at = content.index(b"moov") - 4
    size = int.from_bytes(content[at : at + 4], "big")
    box = struct.pack(">I4s", 8 + len(spherical), b"uuid") + spherical
    moov = (size + len(box)).to_bytes(4, "big") + content[at + 4 : at + size] + box
    path.write_bytes(content[:at] + moov + content[at + size :])
    with pytest.raises(UserError, match=r"v\.mp4: is a 360° video that shows two pictures"):
        gathered(path, tmp_path / "out")
