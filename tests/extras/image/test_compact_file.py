"""The compact file: what is read is what was written, and damaged files are rejected."""

import struct
import xml.etree.ElementTree as ElementTree
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.image.compact_file import (
    decode,
    encode,
    read_compact,
    write_compact,
    write_svg,
)
from snowsplat.extras.image.fit import ImageGaussians
from snowsplat.extras.image.options import Blending, FitOptions
from snowsplat.util.errors import UserError

from ...browser import Browser
from .test_fit import BLENDINGS, fitted, random_gaussians

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("blending", BLENDINGS)
def test_reading_gives_the_same_image_bit_for_bit(blending: Blending, tmp_path: Path) -> None:
    path = tmp_path / "image.gimg"
    written = write_compact(path, random_gaussians(blending, 300))
    read = read_compact(path)
    assert (read.width, read.height, read.blending) == (40, 30, blending)
    assert torch.equal(read.rows, written.rows)
    assert torch.equal(read.background, written.background)
    assert torch.equal(read.render(), written.render())


@pytest.mark.parametrize("count", [1, 30])
@pytest.mark.parametrize("blending", BLENDINGS)
def test_quantisation_changes_the_image_little(blending: Blending, count: int) -> None:
    gaussians = random_gaussians(blending, count)
    read = decode(encode(gaussians))
    assert len(read) == count
    assert psnr(read.render(), gaussians.render()) > 35
    assert len(encode(random_gaussians(blending, 1000))) < 11_000  # 16 or 18 kB without coding


def test_additive_gaussians_are_sorted() -> None:
    """The order has no effect on the image, and none on the file."""
    gaussians = random_gaussians("additive", 200)
    shuffled = gaussians.rows[torch.randperm(200, generator=torch.Generator().manual_seed(1))]
    assert encode(replace(gaussians, rows=shuffled)) == encode(gaussians)


def test_the_order_of_composited_gaussians_is_kept() -> None:
    gaussians = random_gaussians("front-to-back", 200)
    difference = (decode(encode(gaussians)).rows[:, :2] - gaussians.rows[:, :2]).abs()
    assert difference.max() < 0.1  # pixels


def test_no_gaussians() -> None:
    with pytest.raises(ValueError, match="no Gaussians"):
        encode(random_gaussians("additive", 0))


def test_large_values_use_larger_steps() -> None:
    gaussians = random_gaussians("additive", 20)
    gaussians.rows[0, 5] = 1e6
    assert float(decode(encode(gaussians)).rows[:, 5].max()) == pytest.approx(1e6, rel=1e-4)


def test_values_must_be_finite() -> None:
    gaussians = random_gaussians("additive", 20)
    gaussians.rows[3, 2] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        encode(gaussians)


def signed(body: bytes) -> bytes:
    """The content with its right checksum."""
    return body + struct.pack("<I", zlib.crc32(body))


def test_truncated_and_damaged_files(tmp_path: Path) -> None:
    data = encode(random_gaussians("front-to-back", 50))
    path = tmp_path / "image.gimg"
    for length in (0, 3, 4, 20, 29, 30, 60, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(UserError, match=r"image\.gimg: .*(truncated|not a compact file)"):
            read_compact(path)
    for at in range(0, len(data), 7):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        with pytest.raises(UserError, match=r"image\.gimg: "):
            read_compact(path)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (4, b"\x09", "version 9"),
        (5, b"\x02", "header"),
        (6, b"\x00\x00", "header"),
        (6, b"\xff\xff\xff\xff", "header"),
        (10, b"\xff\xff\xff\xff", "header"),
        (10, b"\x00\x00\x00\x00", "header"),
        (10, b"\x33\x00\x00\x00", "number of Gaussians"),
        (14, b"\x00\x00\xc0\x7f", "header"),
        (26, b"\x00\x00\x80\x7f", "header"),
        (30, b"\xff\xff\x7f\x7f", "too large"),
        (110, b"\xff" * 40, "data|number"),
    ],
)
def test_damage_with_a_right_checksum(at: int, value: bytes, message: str) -> None:
    body = encode(random_gaussians("front-to-back", 50))[:-4]
    with pytest.raises(ValueError, match=message):
        decode(signed(body[:at] + value + body[at + len(value) :]))


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        read_compact(tmp_path / "none.gimg")


def test_more_levels_than_gaussians() -> None:
    """Only as many bytes are decompressed as the Gaussians need."""
    gaussians = random_gaussians("front-to-back", 50)
    many = encode(
        ImageGaussians(40, 30, "front-to-back", gaussians.rows.repeat(4000, 1), torch.zeros(3))
    )
    body = bytearray(many[:-4])
    body[10:14] = struct.pack("<I", 50)
    with pytest.raises(ValueError, match="number of Gaussians"):
        decode(signed(bytes(body)))


def test_one_ellipse_per_gaussian(tmp_path: Path) -> None:
    gaussians = random_gaussians("front-to-back", 25)
    write_svg(tmp_path / "image.svg", gaussians)
    root = ElementTree.parse(tmp_path / "image.svg").getroot()
    assert root.get("viewBox") == "0 0 40 30"
    ellipses = root.findall(f"{SVG}ellipse")
    gradients = {gradient.get("id"): gradient for gradient in root.findall(f"{SVG}radialGradient")}
    assert len(ellipses) == len(gradients) == 25
    # The last ellipse is in front: it is the first Gaussian.
    last = ellipses[-1]
    x, y = gaussians.rows[0, :2].tolist()
    assert last.get("transform", "").startswith(f"translate({x:.2f} {y:.2f}) rotate(")
    assert last.get("fill") == "url(#g24)"
    center = gradients["g24"][0]
    opacity = float(torch.sigmoid(gaussians.rows[0, 8]))
    assert float(center.get("stop-opacity", "")) == pytest.approx(opacity, abs=2e-3)


def test_additive_gaussians_have_no_svg(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="front-to-back"):
        write_svg(tmp_path / "image.svg", random_gaussians("additive"))
    assert not list(tmp_path.iterdir())


@pytest.mark.browser
def test_a_browser_shows_the_image(tmp_path: Path) -> None:
    gaussians = fitted(FitOptions(60, steps=100))
    path = tmp_path / "image.svg"
    write_svg(path, gaussians)
    with Browser(200, 150) as browser:
        page = browser.open(path.as_uri())
        shown = page.screenshot()[:30, :40, :3]
    image = torch.from_numpy(np.ascontiguousarray(shown)).float() / 255
    assert psnr(image, gaussians.render().clamp(0, 1)) > 35
