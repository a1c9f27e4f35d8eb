"""The exposure in the EXIF data of photos."""

import pytest
from PIL import Image

from snowsplat.data.photos.exif_exposure import exif_exposure

TIME, STOP, ISO = 0x829A, 0x829D, 0x8827


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_more_light_is_a_larger_value(tmp_path, suffix):
    def value(name, tags):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update(tags)
        path = tmp_path / f"{name}.{suffix}"
        Image.new("RGB", (8, 8)).save(path, exif=exif)
        return exif_exposure(path)

    usual = value("usual", {TIME: 0.01, STOP: 4.0, ISO: 100})
    assert value("longer", {TIME: 0.02, STOP: 4.0, ISO: 100}) == pytest.approx(usual + 1)
    assert value("wider", {TIME: 0.01, STOP: 2.0, ISO: 100}) == pytest.approx(usual + 2)
    assert value("faster", {TIME: 0.01, STOP: 4.0, ISO: 400}) == pytest.approx(usual + 2)
    assert value("no time", {STOP: 4.0, ISO: 100}) is None
    assert value("no light", {TIME: 0.0, STOP: 4.0, ISO: 100}) is None


def test_files_without_exposure(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    (tmp_path / "text.jpg").write_text("not a photo")
    for name in ("plain.png", "text.jpg", "missing.jpg"):
        assert exif_exposure(tmp_path / name) is None
