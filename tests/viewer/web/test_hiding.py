"""Crop and floaters: the ranges of the sliders, and what they hide in a real browser."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.project.site_folder import SiteFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.viewer.web.panel import Description, hiding_of
from snowsplat.viewer.web.publication import write_html, write_site
from snowsplat.viewer.web.scene import ReadyScene, ready

from ...browser import Browser, Page

WIDTH, HEIGHT = 480, 360
SLIDERS = "[...document.querySelectorAll('.snow-hiding input')]"


def blobs(means: list[list[float]], sizes: list[float]) -> Gaussians:
    """Round grey opaque Gaussians."""
    count = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    log_scales = torch.tensor(sizes, dtype=torch.float32).log()[:, None].repeat(1, 3)
    logits, rest = torch.full((count,), 4.0), torch.zeros(count, 0, 3)
    return Gaussians(
        torch.tensor(means).reshape(-1, 3),
        log_scales,
        quats,
        logits,
        torch.zeros(count, 1, 3),
        rest,
    )


def cloud(count: int = 1000) -> Gaussians:
    """Small Gaussians in a ball of radius 1, and ten of the size 0.5 around it."""
    generator = torch.Generator().manual_seed(0)
    inner = torch.randn(count, 3, generator=generator)
    inner = inner / inner.norm(dim=1, keepdim=True) * torch.rand(count, 1, generator=generator)
    outer = torch.randn(10, 3, generator=generator)
    outer = 2 * outer / outer.norm(dim=1, keepdim=True)
    sizes = [0.02] * count + [0.5] * 10
    return blobs([*inner.tolist(), *outer.tolist()], sizes)


def test_floaters_are_hidden_at_first_without_cameras():
    scene = ready(cloud(), ())
    assert len(scene.hiding.shown(scene.gaussians)) == 1000
    largest, least = scene.hiding.size
    limit = largest * (least / largest) ** (scene.hiding.start / 100)
    assert 0.1 * scene.stops.radius <= limit < 0.5
    assert scene.bootstrap(Description("x"), "")["panel"]["hiding"]["start"] == [
        0,
        scene.hiding.start,
    ]


def test_few_gaussians_are_hidden_at_first():
    """Scenes whose Gaussians are all large, or many of them, stay whole."""
    for sizes in ([0.4] * 1000, [0.02] * 900 + [0.5] * 100, list(np.geomspace(1e-3, 1.0, 1000))):
        scene = cloud()
        scene = blobs(scene.means[:1000].tolist(), sizes)
        hiding = hiding_of(scene, torch.zeros(3).double(), 1.0, hide=True)
        assert len(hiding.shown(scene)) >= 980, sizes[-1]


def test_nothing_is_hidden_at_first_with_cameras_or_levels(trained):
    scene = ready(trained.gaussians, trained.cameras)
    assert scene.hiding.start == 0
    assert scene.hiding.shown(scene.gaussians) is scene.gaussians
    assert ready(cloud(), ()).complete().hiding.start == 0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_the_ranges_of_tiny_scenes(count):
    scene = blobs([[float(i), 0.0, 0.0] for i in range(count)], [1.0] * count)
    hiding = hiding_of(scene, torch.zeros(3).double(), 2.0, hide=True)
    assert hiding.distance[0] >= 2 * hiding.distance[1] > 0
    assert hiding.size[0] >= 2 * hiding.size[1] > 0
    assert len(hiding.shown(scene)) == count


def test_values_that_are_not_finite():
    scene = blobs(
        [[0.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]], [1.0, 1.0, math.inf]
    )
    json.dumps(
        hiding_of(scene, torch.zeros(3).double(), 2.0, hide=True).settings(), allow_nan=False
    )


def test_the_picture_of_a_link_shows_what_the_page_shows(tmp_path):
    scene = cloud()
    write_site(tmp_path, ready(scene, ()), Description("cloud"))
    with Image.open(SiteFolder(tmp_path).poster()) as poster:
        corner = np.asarray(poster)[:200, :200]
    assert corner.max() < 20
    whole = ready(scene, ())
    picture = render(whole.gaussians, whole.start.camera(1200, 630)).image
    assert picture[:200, :200].max() > 0.2  # a floater


def set_sliders(page: Page, crop: int, floaters: int) -> None:
    page.evaluate(
        f"[{crop}, {floaters}].forEach((value, i) => {{ const slider = {SLIDERS}[i];"
        "slider.value = value; slider.dispatchEvent(new Event('input')); })"
    )


def psnr(shown: np.ndarray, image: np.ndarray) -> float:
    return -10 * math.log10(np.mean((shown.astype(float) - image) ** 2) / 255**2 + 1e-9)


def picture(scene: ReadyScene, kept: torch.Tensor) -> np.ndarray:
    """A rendering of the Gaussians kept, as in the window of the page."""
    camera = scene.start.camera(WIDTH, HEIGHT)
    with torch.no_grad():
        return render(scene.gaussians.select(kept), camera).image.clamp(0, 1).mul(255).numpy()


def soon_shown(page: Page, image: np.ndarray) -> np.ndarray:
    """A picture of the page that is similar."""
    return page.wait_for_picture(lambda shown: psnr(shown, image) > 30)


@pytest.mark.browser
@pytest.mark.parametrize("webgpu", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_the_sliders(trained, tmp_path, webgpu):
    scene = ready(trained.gaussians, trained.cameras)
    file = tmp_path / "balls.html"
    write_html(file, scene)
    distance = (scene.gaussians.means.double() - scene.stops.middle).norm(dim=1)
    size = scene.gaussians.log_scales.amax(1).exp()
    everything = torch.ones(len(size), dtype=torch.bool)
    cropped = distance <= scene.hiding.distance[0] ** 0.3 * scene.hiding.distance[1] ** 0.7
    small = size <= scene.hiding.size[0] ** 0.5 * scene.hiding.size[1] ** 0.5
    for kept in (cropped, small):
        assert 0.1 < kept.double().mean() < 0.97
    with Browser(WIDTH, HEIGHT, frames=5.0, webgpu=webgpu) as browser:
        page = browser.open(f"{file.as_uri()}?{'' if webgpu else 'webgl'}")
        page.wait_for("!!window.app", 60)
        if webgpu and not page.evaluate("navigator.gpu?.requestAdapter().then(a => !!a)"):
            pytest.skip("this Chromium has no WebGPU in software")
        kind = page.evaluate("window.sse.viewer.app.graphicsDevice.deviceType")
        assert kind == ("webgpu" if webgpu else "webgl2")
        page.evaluate("document.querySelector('.snow-panel').style.opacity = 0")
        page.evaluate("document.querySelector('.sse-ui').style.opacity = 0")
        whole, part = picture(scene, everything), picture(scene, cropped)
        soon_shown(page, whole)
        for values, image in (
            ((70, 0), part),
            ((0, 50), picture(scene, small)),
            ((70, 50), picture(scene, cropped & small)),
        ):
            set_sliders(page, *values)
            assert psnr(soon_shown(page, image), whole) < 30, values
        # The link has the values; at 0, nothing is hidden.
        page.evaluate("[...document.querySelectorAll('.snow-buttons button')].at(-1).click()")
        link = page.wait_for("location.hash", 10)
        assert link.endswith("&hide=70,50")
        set_sliders(page, 0, 0)
        soon_shown(page, whole)
        page.evaluate("location.hash = '#hide=70,0'")
        soon_shown(page, part)
        for wrong in ("#hide=70", "#hide=70,101", "#hide=a,b", "#hide=-1,0", "#"):
            page.evaluate(f"location.hash = '{wrong}'")
            page.wait_for(f"String({SLIDERS}.map(s => s.value)) === '0,0'", 10)
        soon_shown(page, whole)
        assert not page.errors


@pytest.mark.browser
def test_a_page_without_cameras_begins_without_floaters(tmp_path):
    scene = ready(cloud(), ())
    file = tmp_path / "cloud.html"
    write_html(file, scene)
    with Browser(WIDTH, HEIGHT, frames=5.0) as browser:
        page = browser.open(f"{file.as_uri()}?webgl")
        page.wait_for("!!window.app", 60)
        assert page.evaluate(f"{SLIDERS}.map(s => Number(s.value))") == [0, scene.hiding.start]
        page.evaluate("document.querySelector('.snow-panel').style.opacity = 0")
        page.evaluate("document.querySelector('.sse-ui').style.opacity = 0")
        soon_shown(page, picture(scene, torch.arange(1010) < 1000))
        brightness = page.screenshot().mean()
        set_sliders(page, 0, 0)
        page.wait_for_picture(lambda shown: shown.mean() >= brightness + 10)  # the floaters
        assert not page.errors
