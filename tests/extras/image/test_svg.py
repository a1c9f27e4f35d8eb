"""The SVG file: well-formed, one ellipse per Gaussian, and in a browser the same picture."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.image.compact_file import write_svg
from snowsplat.extras.image.options import FitOptions
from snowsplat.util.errors import UserError

from ...browser import Browser
from .test_fit import fitted
from .test_model import random_gaussians

SVG = "{http://www.w3.org/2000/svg}"


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
