"""`image`: the files of a fit, compact files as input, invalid input."""

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from snowsplat.extras.image import fit_image
from snowsplat.extras.image.compact_file import read_compact
from snowsplat.extras.image.fit_image import FILES
from snowsplat.extras.image.options import FitOptions
from snowsplat.scene.render import to_8bit

from ..extras.image.photos import photo


@pytest.fixture(scope="session")
def photo_file(tmp_path_factory) -> Path:
    """40×30 pixels."""
    path = tmp_path_factory.mktemp("photo") / "disc.png"
    Image.fromarray(to_8bit(photo())).save(path)
    return path


@pytest.fixture(scope="session")
def fit(photo_file, tmp_path_factory) -> Path:
    """The output folder of a fit; read-only for the tests."""
    from snowsplat.cli.main import main

    out = tmp_path_factory.mktemp("fit") / "out"
    arguments = ["image", str(photo_file), "-o", str(out), "-n", "50", "--steps", "100", "-q"]
    assert main(arguments) == 0
    return out


def test_the_files_of_a_fit(fit, photo_file):
    assert {path.name for path in fit.iterdir()} == set(FILES)
    metrics = json.loads((fit / "metrics.json").read_text())
    image = np.asarray(Image.open(fit / "image.png"))
    target = np.asarray(Image.open(photo_file))
    assert image.shape == target.shape == (30, 40, 3)
    error = np.square(image.astype(float) - target).mean()
    assert 10 * np.log10(255**2 / error) == pytest.approx(metrics["psnr"], abs=0.5)
    assert metrics["psnr"] > 30
    assert metrics["compact_file"]["psnr"] > metrics["psnr"] - 2
    size = (fit / "image.gimg").stat().st_size
    assert metrics["compact_file"]["bytes"] == size
    assert metrics["compact_file"]["bits_per_pixel"] == pytest.approx(8 * size / 1200)
    course = metrics["course"]
    assert [moment["step"] for moment in course] == sorted({m["step"] for m in course})
    assert course[-1]["step"] == 100
    assert course[-1]["gaussians"] == 50
    assert course[0]["psnr"] < 20 < course[-1]["psnr"]


def test_the_video_ends_with_the_image(fit):
    with av.open(str(fit / "forming.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert frames[0].shape == (360, 480, 3)
    assert 100 < len(frames) <= 144
    image = Image.open(fit / "image.png").resize((480, 360), Image.Resampling.BICUBIC)
    assert np.abs(frames[-1].astype(float) - np.asarray(image)).mean() < 8
    assert np.abs(frames[0].astype(float) - np.asarray(image)).mean() > 20


def test_the_page_is_self_contained(fit):
    text = (fit / "report.html").read_text(encoding="utf-8")
    ElementTree.fromstring(text.partition("\n")[2])
    assert "50 2D Gaussians" in text
    assert "data:video/mp4;base64," in text
    assert "http" not in text.replace("http://www.w3.org", "")


def test_a_compact_file_becomes_an_image(run, fit, tmp_path):
    target = tmp_path / "decoded.png"
    result = run("image", fit / "image.gimg", "-o", target)
    assert (result.code, result.out) == (0, f"{target}: 40 × 30 pixels\n")
    wanted = to_8bit(read_compact(fit / "image.gimg").render())
    assert np.array_equal(np.asarray(Image.open(target)), wanted)
    assert run("image", fit / "image.gimg", "-o", target, "--size", "120").code == 0
    assert Image.open(target).size == (120, 90)


def test_additive_gaussians_have_no_svg(run, fit, photo_file, tmp_path):
    arguments = ("-n", 30, "--steps", 30, "--blending", "additive", "-q")
    result = run("image", photo_file, "-o", tmp_path / "out", *arguments)
    assert result.code == 0, result.err
    assert "30 Gaussians" in result.out
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(FILES) - {"image.svg"}


def test_an_earlier_fit_is_not_replaced_by_mistake(refused, run, photo_file, tmp_path):
    arguments = ("image", photo_file, "-o", tmp_path / "out", "-n", 5, "--steps", 3, "-q")
    assert run(*arguments).code == 0
    before = (tmp_path / "out" / "image.gimg").read_bytes()
    assert "contains an earlier fit; use --overwrite" in refused(*arguments)
    assert run(*arguments, "--seed", 1, "--overwrite").code == 0
    assert (tmp_path / "out" / "image.gimg").read_bytes() != before


def test_an_interrupted_fit_replaces_nothing(fit, photo_file, tmp_path, monkeypatch):
    out = shutil.copytree(fit, tmp_path / "out")
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(fit_image, "write_image_report", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit_image.fit_image(photo_file, out, FitOptions(gaussians=9, steps=5), overwrite=True)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_large_photo_is_scaled_down_and_rotated(run, tmp_path):
    source = tmp_path / "sideways.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6  # rotated by 90°
    Image.fromarray(to_8bit(photo(120, 60))).save(source, exif=exif)
    out = tmp_path / "out"
    assert run("image", source, "-o", out, "-n", 5, "--steps", 3, "--size", 50, "-q").code == 0
    assert Image.open(out / "image.png").size == (25, 50)


def test_invalid_input_is_one_line(refused, photo_file, fit, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "text.jpg").write_text("no photo")
    (tmp_path / "damaged.gimg").write_bytes((fit / "image.gimg").read_bytes()[:-9])
    assert "needs a photo and an output folder" in refused("image", photo_file)
    assert "needs a photo and an output folder" in refused("image", "-o", out)
    assert "none.jpg" in refused("image", tmp_path / "none.jpg", "-o", out)
    assert "text.jpg" in refused("image", tmp_path / "text.jpg", "-o", out)
    assert "is a file" in refused("image", photo_file, "-o", photo_file)
    assert "--gaussians" in refused("image", photo_file, "-o", out, "-n", 0)
    assert "--steps" in refused("image", photo_file, "-o", out, "--steps", 0)
    assert "--size" in refused("image", photo_file, "-o", out, "--size", 4)
    assert "--threads" in refused("image", photo_file, "-o", out, "--threads", 0)
    assert "damaged" in refused("image", tmp_path / "damaged.gimg", "-o", tmp_path / "a.png")
    assert "-o FILE.png" in refused("image", fit / "image.gimg", "-o", out)
    assert "--size" in refused("image", fit / "image.gimg", "-o", out / "a.png", "--size", 1)
    assert not out.exists()
