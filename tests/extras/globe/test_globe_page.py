"""The page of a globe, opened from disk in a real browser without a network."""

import base64
import dataclasses
import json
import re
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from snowsplat.extras.globe.glass import draw
from snowsplat.extras.globe.globe_page import _reduced_colors, encode, write_page
from snowsplat.extras.globe.globe_video import SHAKE_DIRECTION, orbit_camera
from snowsplat.extras.globe.layout import Arrangement
from snowsplat.extras.globe.physics import LONGEST_STEP, Snow, random_numbers, shake_acceleration
from snowsplat.ops import reference
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.render import render

from ...browser import Browser, Page

SIDE = 240  # pixels


def gaussians(count: int = 3000) -> Gaussians:
    """A red and a blue block of Gaussians that stand on the floor of the globe."""
    random = np.random.default_rng(1)
    means = random.uniform((-0.55, -0.3, -0.25), (0.55, 0.52, 0.25), (count, 3))
    colors = np.where(means[:, :1] < 0, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]])
    sh = random.normal(size=(count, 3, 3)) * 0.02
    return Gaussians(
        torch.tensor(means).float(),
        torch.tensor(random.uniform(-4.2, -3.4, (count, 3))).float(),
        torch.tensor(random.normal(size=(count, 4))).float(),
        torch.tensor(random.uniform(1.0, 4.0, count)).float(),
        torch.tensor((colors - 0.5) / SH_C0)[:, None].float(),
        torch.tensor(sh).float(),
    )


def test_the_data_are_close_to_the_gaussians():
    scene = gaussians(500)
    columns, data = encode(scene)
    assert len(data) == 500 * 26
    read = {}
    for column in columns:
        kind = np.dtype(column["kind"])
        values = np.frombuffer(data, kind, column["length"], column["offset"])
        read[column["name"]] = column["low"] + column["scale"] * values.astype(float)
    assert np.abs(read["position"].reshape(-1, 3) - scene.means.numpy()).max() < 2e-5
    assert np.abs(read["log_scales"].reshape(-1, 3) - scene.log_scales.numpy()).max() < 0.01
    assert np.abs(read["quat"].reshape(-1, 4) - scene.rotations.numpy()).max() < 0.005
    assert np.abs(read["opacity"] - scene.opacities.numpy()).max() < 0.003
    assert np.abs(read["color"].reshape(-1, 3) - scene.base_colors.numpy()).max() < 0.005
    # A scene with SH degree 1 keeps its coefficients.
    assert np.abs(read["sh"].reshape(-1, 3, 3) - scene.sh_rest.numpy()).max() < 0.001


def test_higher_sh_degrees_are_approximated():
    scene = gaussians(50)
    generator = torch.Generator().manual_seed(2)
    scene.sh_rest = 0.05 * torch.randn(50, 15, 3, generator=generator)
    base, sh = _reduced_colors(scene)
    azimuth = torch.linspace(0, 6, 40).double()
    elevation = torch.linspace(0.0, 0.6, 40).double()
    level = elevation.cos()
    seen = torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], 1)
    coefficients = torch.cat([scene.sh_dc, scene.sh_rest], 1).double()
    full = 0.5 + torch.einsum("dk,nkc->ndc", reference.sh_basis(seen, 3), coefficients)
    low = base[:, None] + torch.einsum(
        "dk,nkc->ndc", reference.sh_basis(seen, 1)[:, 1:], sh.double()
    )
    constant = scene.base_colors[:, None]
    # Better than to leave out the higher degrees, or all of them.
    cut = constant + torch.einsum(
        "dk,nkc->ndc", reference.sh_basis(seen, 1)[:, 1:], scene.sh_rest[:, :3].double()
    )
    error = (low - full).square().mean()
    assert error < 0.8 * (cut - full).square().mean()
    assert error < 0.8 * (constant - full).square().mean()


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[Page]:
    path = tmp_path_factory.mktemp("page") / "a globe.html"
    write_page(path, Arrangement(gaussians(), True), "Two </script> blocks")
    with Browser(SIDE, SIDE) as browser:
        page = browser.open(path.as_uri())
        page.wait_for("window.snowGlobe && snowGlobe.buffers && snowGlobe.renderer.count")
        # Everything stands still unless a test moves it.
        page.evaluate("snowGlobe.paused = true, snowGlobe.adapts = false, snowGlobe.turned = 0")
        hide = "document.querySelectorAll('nav, p').forEach(part => part.style.display = 'none')"
        page.evaluate(hide)
        yield page
        assert not page.errors


def advance(page: Page, seconds: float) -> None:
    page.evaluate(f"snowGlobe.advance({seconds})", 120)


def picture(page: Page) -> np.ndarray:
    # The pixels of the canvas are read at once, because it does not keep them.
    script = "snowGlobe.drawn = false, snowGlobe.draw(), snowGlobe.canvas.toDataURL()"
    page.evaluate(f"window.drawn = ({script}), 0")
    return page.screenshot().astype(float)


def columns_of(html: str) -> dict[str, np.ndarray]:
    about = json.loads(re.findall(r'id="about">(.*?)</script>', html)[0])
    data = base64.b64decode(re.findall(r'id="data">(.*?)</script>', html)[0])
    return {
        c["name"]: c["low"]
        + c["scale"] * np.frombuffer(data, c["kind"], c["length"], c["offset"]).astype(float)
        for c in about["columns"]
    }


@pytest.mark.browser
def test_the_page_opens_without_a_network(page):
    assert page.evaluate("document.title") == "Two </script> blocks - snow globe"
    assert all(url.startswith(("file://", "blob:", "data:")) for url in page.requests)
    assert page.evaluate("fetch('http://127.0.0.1:9/').then(() => 1, () => 2)") == 2
    page.console.clear()  # the policy has reported the request


@pytest.mark.browser
def test_the_random_numbers_are_those_of_the_video(page):
    found = page.evaluate("Array.from(randomNumbers(1000, 3))")
    assert np.array_equal(found, random_numbers(1000, 3))


@pytest.mark.browser
def test_the_picture_is_that_of_the_video(page):
    """Backdrop, glass and Gaussians, computed by WebGL and by NumPy and the rasterizer."""
    camera = orbit_camera(0.0, SIDE, SIDE)
    # The page leaves more room below the globe for the buttons.
    focal = camera.fx * 0.94
    camera = type(camera)(SIDE, SIDE, focal, focal, SIDE / 2, 0.47 * SIDE, camera.cam_from_world)
    page.evaluate("snowGlobe.request([], true)")
    advance(page, 0)
    shown = picture(page)
    output = render(gaussians(), camera)
    wanted = draw(camera).around(output.image.numpy(), output.alpha.numpy()).astype(float)
    difference = np.abs(shown - wanted)
    difference[165:195, 60:180] = 0  # the plate
    assert difference.mean() < 2.5
    assert np.quantile(difference.max(2), 0.97) < 24
    left, right = shown[115:135, 85:110].mean((0, 1)), shown[115:135, 130:155].mean((0, 1))
    assert left[0] > left[2] + 60
    assert right[2] > right[0] + 60


@pytest.mark.browser
def test_a_browser_in_chinese_shows_chinese_texts(tmp_path):
    write_page(tmp_path / "globe.html", Arrangement(gaussians(1), True), "桌子")
    with Browser(SIDE, SIDE) as browser:
        page = browser.open((tmp_path / "globe.html").as_uri(), language="zh-CN")
        texts = page.evaluate("[document.title, document.body.innerText].join(' ')")
        assert not page.errors
    assert re.search("桌子 - 雪花球 .*摇晃手机。.*摇晃.*复原", texts, re.DOTALL)
    assert not re.search("[a-z]", texts)


@pytest.mark.browser
def test_the_picture_of_an_antialiased_scene(tmp_path):
    """Gaussians of about the size of a pixel are as opaque as in the video."""
    scene = gaussians()
    scene.log_scales -= 1.5
    scene.antialiased = True
    write_page(tmp_path / "globe.html", Arrangement(scene, True), "Dots")
    camera = orbit_camera(0.0, SIDE, SIDE)
    focal = camera.fx * 0.94
    camera = type(camera)(SIDE, SIDE, focal, focal, SIDE / 2, 0.47 * SIDE, camera.cam_from_world)
    errors = []
    with Browser(SIDE, SIDE) as browser:
        page = browser.open((tmp_path / "globe.html").as_uri())
        page.wait_for("window.snowGlobe && snowGlobe.buffers && snowGlobe.renderer.count")
        page.evaluate("snowGlobe.paused = true, snowGlobe.adapts = false, snowGlobe.turned = 0")
        page.evaluate("snowGlobe.request([], true)")
        advance(page, 0)
        shown = picture(page)
        assert not page.errors
    for antialiased in (True, False):
        output = render(dataclasses.replace(scene, antialiased=antialiased), camera)
        wanted = draw(camera).around(output.image.numpy(), output.alpha.numpy()).astype(float)
        errors.append(np.abs(shown - wanted)[90:150, 60:180].mean())
    assert errors[0] < 4
    assert errors[1] > 3 * errors[0]


@pytest.mark.browser
def test_a_shake_and_remember(page):
    before = picture(page)
    simulated = Snow(quantised_home())
    simulated.time = page.evaluate("snowGlobe.result.time")  # the flow depends on it
    page.evaluate("snowGlobe.shake()")
    advance(page, 18 * LONGEST_STEP)
    # The same motion as in NumPy, as long as rounding errors have not grown.
    axes = orbit_camera(0.0, SIDE, SIDE).world_from_cam[:, :3].numpy()
    direction = axes @ np.array(SHAKE_DIRECTION)
    for i in range(18):
        x, y, z = (shake_acceleration(i * LONGEST_STEP) * direction).tolist()
        simulated.step(LONGEST_STEP, (x, y, z))
    state = np.array(page.evaluate("Array.from(snowGlobe.buffers.state)")).reshape(-1, 4)
    moved = (simulated.position != simulated.home).any(0)
    assert moved.mean() > 0.2
    error = np.abs(state[: len(moved), :3].T - simulated.position)
    assert np.quantile(error, 0.99) < 2e-4
    assert error.max() < 2e-2

    advance(page, 2.0)
    during = picture(page)
    inside = np.s_[40:150, 50:190]
    assert np.abs(during - before)[inside].mean() > 15
    assert page.evaluate("snowGlobe.result.standing") is False
    page.evaluate("snowGlobe.remember()")
    advance(page, 3.7)
    assert page.evaluate("snowGlobe.result.standing") is True
    assert np.abs(picture(page) - before).mean() < 0.1


def quantised_home() -> np.ndarray:
    columns, data = encode(gaussians())
    column = columns[0]
    values = np.frombuffer(data, column["kind"], column["length"], column["offset"])
    return (column["scale"] * values).reshape(-1, 3).T


@pytest.mark.browser
def test_input(page):
    """Dragging turns the globe, fast changes of direction shake it, keys work."""
    page.evaluate("snowGlobe.azimuth = 0, snowGlobe.push = [0, 0, 0]")
    page.drag(60, 120, 140, 120)
    assert page.evaluate("snowGlobe.azimuth") == pytest.approx(-80 * 0.007, abs=0.01)
    page.evaluate("snowGlobe.azimuth = 0, snowGlobe.shaken = Infinity")
    event = "dispatchEvent(new KeyboardEvent('keydown', { key: '%s' }))"
    page.evaluate(event % "ArrowRight")
    assert page.evaluate("snowGlobe.azimuth") == pytest.approx(-0.1)
    page.evaluate(event % " ")
    assert page.evaluate("snowGlobe.shaken") == 0
    motion = "dispatchEvent(new DeviceMotionEvent('devicemotion', { acceleration: %s }))"
    page.evaluate("snowGlobe.push = [0, 0, 0]")
    page.evaluate(motion % "{ x: 1, y: 0, z: 0 }")
    assert page.evaluate("snowGlobe.push") == [0, 0, 0]  # too weak
    page.evaluate(motion % "{ x: 10, y: 4, z: 0 }")
    assert page.evaluate("snowGlobe.push") == pytest.approx([15, -6, 0])
    page.evaluate("snowGlobe.azimuth = 0, snowGlobe.push = [0, 0, 0], snowGlobe.shaken = Infinity")


@pytest.mark.browser
def test_the_scene_turns_unless_the_user_prefers_less_motion(page):
    for value, turns in (("reduce", False), ("no-preference", True)):
        feature = {"name": "prefers-reduced-motion", "value": value}
        page.call("Emulation.setEmulatedMedia", features=[feature])
        page.evaluate("snowGlobe.turned = 0, snowGlobe.turn(1)")
        assert (page.evaluate("snowGlobe.turned") > 0) is turns
    page.evaluate("snowGlobe.turned = 0, snowGlobe.seconds = 0")


@pytest.mark.browser
def test_the_buttons_work_while_the_page_runs(page):
    """The scene is shaken and remembered in real time, or in slow motion on a slow computer."""
    press = "document.getElementById('%s').click()"
    page.evaluate("snowGlobe.shaken = Infinity, snowGlobe.paused = false")
    page.wait_for("snowGlobe.result.standing")
    assert page.evaluate("document.getElementById('remember').disabled")
    page.evaluate(press % "shake")
    page.wait_for("!document.getElementById('remember').disabled", 60)
    page.evaluate("snowGlobe.shaken = Infinity")
    page.evaluate(press % "remember")
    page.wait_for("snowGlobe.result.remembering")
    page.evaluate("snowGlobe.paused = true")
    advance(page, 3.0)
    page.evaluate("snowGlobe.paused = false")  # the rest in real time
    page.wait_for("snowGlobe.result.standing", 120)
    page.evaluate("snowGlobe.paused = true, snowGlobe.turned = 0, snowGlobe.seconds = 0")


@pytest.mark.browser
def test_a_slow_computer_shows_fewer_pixels_and_then_fewer_gaussians(page):
    page.evaluate("snowGlobe.adapts = true, snowGlobe.intervals.length = 0")
    page.evaluate("for (let i = 0; i < 30; i++) snowGlobe.adapt(25)")
    assert page.evaluate("[snowGlobe.pixelRatio, snowGlobe.count]") == [1, 3000]
    page.evaluate("snowGlobe.result.milliseconds = 5")
    page.evaluate("for (let i = 0; i < 90; i++) snowGlobe.adapt(60)")
    assert page.evaluate("snowGlobe.pixelRatio") == pytest.approx(0.6)
    # At least 10,000 Gaussians are always displayed.
    page.evaluate("for (let i = 0; i < 60; i++) snowGlobe.adapt(60)")
    assert page.evaluate("snowGlobe.count") == 3000
    page.evaluate("snowGlobe.count = 20000")
    page.evaluate("for (let i = 0; i < 30; i++) snowGlobe.adapt(60)")
    assert page.evaluate("snowGlobe.count") == 16000
    page.evaluate("snowGlobe.count = 3000, snowGlobe.pixelRatio = 1, snowGlobe.adapts = false")
