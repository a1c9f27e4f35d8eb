"""360° panoramas are recognised, and ordinary photos twice as wide as high are none."""

import struct

import numpy as np
import pytest
from PIL import Image

from snowsplat.sfm.ingest.inputs import GatherOptions, gather
from snowsplat.sfm.ingest.panorama import (
    PANORAMA,
    STITCHED,
    is_spherical_video,
    panorama_in_metadata,
    shows_all_around,
)
from snowsplat.sfm.progress import silent
from snowsplat.util.errors import UserError

from ..pictures import pan, photo, wall, write_photos, write_video

_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description '
    b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" %s/></x:xmpmeta>'
)
_WHOLE = _XMP % b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4096"'
_PART = _XMP % (
    b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="4096" '
    b'GPano:CroppedAreaImageWidthPixels="1800"'
)


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


@pytest.mark.parametrize("seed", range(6))
def test_pixels_of_a_panorama(seed):
    assert shows_all_around(Image.fromarray(panorama(seed)))


@pytest.mark.parametrize("seed", range(6))
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
    assert panorama_in_metadata({"xmp": _WHOLE}) == PANORAMA
    assert panorama_in_metadata({"XML:com.adobe.xmp": _WHOLE.decode()}) == PANORAMA
    assert panorama_in_metadata({"xmp": _PART}) == STITCHED
    element = b"<GPano:ProjectionType>cylindrical</GPano:ProjectionType>"
    assert panorama_in_metadata({"xmp": element}) == STITCHED
    assert panorama_in_metadata({"xmp": _XMP % b'GPano:UsePanoramaViewer="False"'}) is None
    assert panorama_in_metadata({"xmp": 3}) is None
    assert panorama_in_metadata({}) is None


def with_box(path, *boxes):
    path.write_bytes(b"".join(struct.pack(">I4s", 8 + len(c), kind) + c for kind, c in boxes))
    return path


def test_metadata_of_spherical_videos(tmp_path):
    first = b"<GSpherical:Spherical>true</GSpherical:Spherical>"
    second = b"....sv3d....svhd........proj....prhd............equi"
    head, data = (b"ftyp", b"isom" * 4), (b"mdat", first * 3)
    assert is_spherical_video(with_box(tmp_path / "a.mp4", head, data, (b"moov", first)))
    assert is_spherical_video(with_box(tmp_path / "b.mp4", head, (b"moov", second)))
    assert not is_spherical_video(with_box(tmp_path / "c.mp4", head, data, (b"moov", b"trak" * 9)))
    assert not is_spherical_video(with_box(tmp_path / "d.mp4", head, data))
    ordinary = write_video(tmp_path / "e.mp4", pan(3))
    assert not is_spherical_video(ordinary)


def gathered(source, dataset):
    dataset.mkdir()
    return gather([source], dataset, GatherOptions(), silent)


@pytest.mark.parametrize("xmp", [_WHOLE, None])
def test_panoramas_are_refused_by_name(tmp_path, xmp):
    (tmp_path / "p").mkdir()
    for i in range(4):
        options = {"xmp": xmp} if xmp else {}
        Image.fromarray(panorama(i)).save(tmp_path / "p" / f"{i}.jpg", quality=95, **options)
    with pytest.raises(UserError, match="all 4 images are 360° panoramas.* cut each into") as error:
        gathered(tmp_path / "p", tmp_path / "out")
    assert "\n" not in str(error.value)


def test_a_panorama_among_photos_is_left_out_by_name(tmp_path):
    source = write_photos(tmp_path / "p", 4)
    photo(60).save(source / "pano.jpg", quality=95, xmp=_WHOLE)
    made = gathered(source, tmp_path / "out")
    assert len(made.photos) == 4
    assert made.skipped == [(str(source / "pano.jpg"), PANORAMA)]


def test_panoramas_with_an_edge_at_a_pole_are_refused_with_the_others(tmp_path):
    (tmp_path / "p").mkdir()
    for i in range(6):
        picture = panorama(i)
        if i < 2:
            picture[:4] = np.where(np.arange(512) % 256 < 128, 20, 220)[:, None]
            assert not shows_all_around(Image.fromarray(picture))
        Image.fromarray(picture).save(tmp_path / "p" / f"{i}.jpg", quality=95)
    with pytest.raises(UserError, match="all 6 images are 360° panoramas"):
        gathered(tmp_path / "p", tmp_path / "out")


def test_a_spherical_video_is_refused_by_name(tmp_path):
    frames = [np.roll(panorama(1), 9 * i, axis=1) for i in range(10)]
    with pytest.raises(UserError, match=r"v\.mp4: is a 360° video"):
        gathered(write_video(tmp_path / "v.mp4", frames), tmp_path / "out")
