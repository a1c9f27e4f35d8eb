"""Photos with an ICC profile: the same sRGB colours in structure from motion and in training."""

import logging

import numpy as np
import pytest
from PIL import Image, ImageCms

from snowsplat.data.photos import colour_profile
from snowsplat.data.photos.decode import ImageSource, load_image, load_thumbnail
from snowsplat.sfm.ingest.photos.photo_files import decode, read_header, save

from .colour_profiles import DISPLAY_P3, PROPHOTO, cmyk_profile, grey_profile, to_xyz
from .colour_profiles import colour_profile as made

SIZE = 48
_SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
# Moderate colours, which all colour spaces have.
PATCHES = np.array([[200, 60, 50], [60, 170, 80], [70, 80, 190], [220, 200, 90]], np.uint8)


def picture(colours) -> np.ndarray:
    """(SIZE, SIZE, C): a patch of each colour."""
    return np.repeat(np.repeat(np.asarray(colours)[None], SIZE, 0), SIZE // len(colours), 1)


def encoded(srgb, primaries, gamma) -> np.ndarray:
    """sRGB levels as levels of another colour space."""
    part = srgb / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    other = linear @ to_xyz(_SRGB).T @ np.linalg.inv(to_xyz(primaries)).T
    return np.rint(255 * np.clip(other, 0, 1) ** (1 / gamma)).astype(np.uint8)


def trained(path, **options) -> np.ndarray:
    planes = load_image(ImageSource(path, SIZE, SIZE, **options))
    return planes.permute(1, 2, 0).numpy().astype(int)


def matched(path) -> Image.Image:
    """The photo as structure from motion decodes it."""
    return decode(path, read_header(path), None)


@pytest.mark.parametrize("primaries", [DISPLAY_P3, PROPHOTO])
@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "webp"])
def test_every_reader_converts_to_srgb(tmp_path, primaries, ending):
    path = tmp_path / f"a.{ending}"
    pixels = picture(encoded(PATCHES, primaries, 2.2))
    options = {"lossless": True} if ending == "webp" else {"quality": 100, "subsampling": 0}
    Image.fromarray(pixels).save(path, icc_profile=made(primaries, 2.2), **options)
    expected = picture(PATCHES).astype(int)
    assert np.abs(pixels - expected).max() > 20
    small = load_thumbnail(ImageSource(path, SIZE, SIZE), SIZE)[:3].transpose(1, 2, 0)
    for got in (trained(path), np.asarray(matched(path), int), small):
        assert np.abs(got - expected).max() <= 4  # ProPhoto has coarse steps

    copy = tmp_path / "copy.png"
    save(matched(path), copy, path)
    with Image.open(copy) as image:
        assert "icc_profile" not in image.info  # the copy would be converted again
    assert np.abs(trained(copy) - expected).max() <= 4


def test_a_rotated_and_a_transparent_photo(tmp_path):
    pixels = encoded(picture(PATCHES), DISPLAY_P3, 2.2)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(pixels).save(
        tmp_path / "a.png", icc_profile=made(DISPLAY_P3, 2.2), exif=exif.tobytes()
    )
    expected = picture(PATCHES).astype(int)[::-1, ::-1]
    assert np.abs(np.asarray(matched(tmp_path / "a.png"), int) - expected).max() <= 2
    assert np.abs(trained(tmp_path / "a.png", apply_orientation=True) - expected).max() <= 2

    alpha = np.full((SIZE, SIZE, 1), 255, np.uint8)
    alpha[:8] = 0
    Image.fromarray(np.concatenate([pixels, alpha], 2)).save(
        tmp_path / "b.png", icc_profile=made(DISPLAY_P3, 2.2)
    )
    got = trained(tmp_path / "b.png")
    assert (got[:8] == 0).all()
    assert np.abs(got[8:, :, :3] - picture(PATCHES).astype(int)[8:]).max() <= 2


def test_grey_photos_stay_grey(tmp_path):
    grey = np.tile(np.linspace(0, 255, SIZE).astype(np.uint8), (SIZE, 1))
    Image.fromarray(grey).save(tmp_path / "a.png", icc_profile=grey_profile(1.0))
    image = matched(tmp_path / "a.png")
    light = grey[0] / 255
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert image.mode == "L"
    assert np.abs(np.asarray(image, int)[0] - 255 * srgb).max() <= 1
    assert np.abs(trained(tmp_path / "a.png")[0, :, 1] - 255 * srgb).max() <= 1
    # Some programs give grey photos the profile of a colour space.
    Image.fromarray(grey).save(tmp_path / "b.png", icc_profile=made(_SRGB, 1.0))
    assert np.abs(np.asarray(matched(tmp_path / "b.png"), int)[0] - 255 * srgb).max() <= 1


def test_deep_grey_with_a_profile(tmp_path):
    values = np.tile(np.linspace(0, 65535, SIZE).astype(np.uint16), (SIZE, 1))
    Image.fromarray(values).save(tmp_path / "a.png", icc_profile=grey_profile(1.0))
    assert np.abs(trained(tmp_path / "a.png")[0, SIZE // 2] - 188).max() <= 2


def test_cmyk_with_a_profile(tmp_path):
    """Without the profile, the inks are multiplied; this profile has the lightness of their sum."""
    inks = picture([[0, 0, 0, 0], [255, 0, 0, 0], [255, 255, 0, 0], [255, 255, 255, 255]])
    Image.fromarray(inks.astype(np.uint8), "CMYK").save(
        tmp_path / "a.jpg", quality=100, icc_profile=cmyk_profile(0.0)
    )
    got = trained(tmp_path / "a.jpg")[SIZE // 2, 6 :: SIZE // 4]
    assert np.abs(got - got.mean(1, keepdims=True)).max() <= 2  # grey
    assert np.abs(got[:, 0] - [255, 185, 119, 0]).max() <= 4  # L* = 100, 75, 50, 0


def test_adobe_rgb_without_a_profile(tmp_path):
    """Cameras that write only EXIF's interoperability index; a copy says that it is in sRGB."""
    adobe = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
    exif = Image.Exif()
    exif[0x0112] = 3
    details = exif.get_ifd(0x8769)
    details[0xA001] = 65535
    details[0xA005] = {1: "R03", 2: b"0100"}
    path = tmp_path / "_MG_1.jpg"
    pixels = picture(encoded(PATCHES, adobe, 563 / 256))[::-1, ::-1]
    Image.fromarray(pixels).save(path, quality=100, subsampling=0, exif=exif)
    expected = picture(PATCHES).astype(int)
    assert np.abs(pixels[::-1, ::-1] - expected).max() > 8
    assert np.abs(trained(path, apply_orientation=True) - expected).max() <= 3
    save(matched(path), tmp_path / "b.png", path)
    assert np.abs(trained(tmp_path / "b.png") - expected).max() <= 3


@pytest.mark.parametrize(
    ("profile", "reason"),
    [(b"no profile", "is damaged"), (grey_profile(2.0), "is not one for its pixels")],
)
def test_a_profile_that_cannot_be_used_is_named_once(tmp_path, caplog, profile, reason):
    profile += str(tmp_path).encode()  # no earlier test has named this one
    for name in ("a.png", "b.png"):
        Image.fromarray(picture(PATCHES)).save(tmp_path / name, icc_profile=profile)
        with caplog.at_level(logging.WARNING):
            assert np.array_equal(trained(tmp_path / name), picture(PATCHES))
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'a.png'}: its colour profile {reason}, so it is not used"
    ]


def test_profiles_of_srgb_cost_nothing(tmp_path, monkeypatch):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(picture(PATCHES)).save(tmp_path / "a.png", icc_profile=srgb)
    colour_profile._transform(srgb, "RGB")
    monkeypatch.setattr(ImageCms.ImageCmsTransform, "apply", None)
    assert np.array_equal(trained(tmp_path / "a.png"), picture(PATCHES))


def test_damaged_profiles(tmp_path):
    generator = np.random.default_rng(0)
    kinds = [(made(DISPLAY_P3, 2.2), "RGB"), (grey_profile(1.8), "L"), (cmyk_profile(0), "CMYK")]
    for i in range(300):
        profile, pixels = kinds[i % 3]
        data = np.frombuffer(profile, np.uint8).copy()
        data[generator.integers(0, min(len(data), 400), 4)] = generator.integers(0, 256, 4)
        image = Image.new(pixels, (4, 4))
        image.info["icc_profile"] = data.tobytes()[: generator.integers(1, len(data) + 1)]
        assert colour_profile.to_srgb(image, tmp_path).size == (4, 4)
