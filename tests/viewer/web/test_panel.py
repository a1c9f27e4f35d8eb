"""The panel of the page, in a real browser: stops, links to views, Frame, windows of any shape."""

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
import torch

from snowsplat.data import Points
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.viewer.web.panel import Description, view_numbers
from snowsplat.viewer.web.publication import write_html
from snowsplat.viewer.web.scene import ReadyScene, ready
from snowsplat.viewer.web.stops import first_stop, shown_at, stops_of

from ...browser import Browser, Page

ENTITY = "window.sse.viewer.app.root.findByName('camera')"
POSE = f"(e => [e.getPosition(), e.forward].flatMap(v => [v.x, v.y, v.z]))({ENTITY})"
FAILURE = "document.querySelector('.snow-failure')?.textContent"
MODE = "window.sse.viewer.state.cameraMode"


@pytest.fixture(scope="module")
def scene(trained) -> ReadyScene:
    """What is beside each photo is in others, as far as the windows of these tests show it."""
    scene = ready(trained.gaussians, trained.cameras, (0.0, 0.0, 0.0))
    return scene._replace(stops=scene.stops._replace(seen=[(3.0, 3.0)] * len(scene.stops.views)))


@pytest.fixture(scope="module")
def file(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("panel") / "balls.html"
    write_html(path, scene, Description("Balls <&>", "CC0", date(2026, 11, 24)))
    return path


@contextmanager
def opened(file: Path, width: int, height: int, link: str = "") -> Iterator[Page]:
    # Few pixels of the screen: the tests look at poses and buttons, not at the picture.
    with Browser(width, height, 0.25, frames=5.0) as browser:
        page = browser.open(f"{file.as_uri()}?webgl{link}")
        page.wait_for("!!window.app", 60)
        yield page
        assert not page.errors
        assert all(url.startswith(("file://", "blob:null/", "data:")) for url in page.requests)


def pose_of(view: list[float]) -> list[float]:
    """Position and direction of a view in the viewer's frame."""
    position, target = view[:3], view[3:6]
    distance = math.dist(position, target)
    return [*position, *((b - a) / distance for a, b in zip(position, target, strict=True))]


def wait_for_pose(page: Page, expected: list[float]) -> None:
    near = f"{POSE}.every((x, i) => Math.abs(x - {json.dumps(expected)}[i]) < 5e-3)"
    try:
        page.wait_for(near, 30)
    except Exception:
        raise AssertionError(f"{page.evaluate(POSE)} is not {expected}") from None


def click(page: Page, text: str) -> None:
    buttons = "[...document.querySelectorAll('.snow-panel button')]"
    page.evaluate(f"{buttons}.find(b => b.textContent === '{text}').click()")


@pytest.mark.browser
def test_the_panel(file, scene):
    start, stops = (
        [view_numbers(view, scene.start.aspect) for view in views]
        for views in ([scene.start], scene.stops.views)
    )
    with opened(file, 480, 360) as page:
        text = page.evaluate("document.querySelector('.snow-card').innerText")
        assert text.startswith("Balls <&>")
        assert f"{len(scene.gaussians):,} Gaussians · 2026-11-24 · CC0" in text
        wait_for_pose(page, pose_of(start[0]))
        # Stops: their pictures are shown on demand; a click moves to the view.
        strip = "document.querySelector('.snow-stops')"
        assert page.evaluate(f"{strip}.offsetParent === null")
        click(page, "Photos")
        assert page.evaluate(f"{strip}.children.length") == len(stops) == 12
        loaded = (
            f"new Promise(done => {{ const i = new Image(); i.onload = () => done(i.naturalWidth);"
            f'i.src = /url\\("(.*)"\\)/.exec({strip}.children[3].style.backgroundImage)[1] }})'
        )
        assert page.evaluate(loaded) == 12 * round(128 * 96 / 72)
        page.evaluate(f"{strip}.children[3].click()")
        wait_for_pose(page, pose_of(stops[3]))
        page.drag(100, 280, 180, 290)
        assert page.evaluate(MODE) == "orbit"
        # Frame: the camera looks at the subject, which fits into the window.
        page.key("f")
        x, y, z = scene.stops.middle.tolist()
        to_subject = (
            f"(e => {{ const p = e.getPosition(), f = e.forward;"
            f"const d = [{-x} - p.x, {-y} - p.y, {z} - p.z], n = Math.hypot(...d);"
            f"return [n, (d[0] * f.x + d[1] * f.y + d[2] * f.z) / n]; }})({ENTITY})"
        )
        tangent = math.tan(math.radians(scene.start.fov / 2)) * 3 / 4
        distance = scene.stops.radius / math.sin(math.atan(tangent))
        page.wait_for(f"{to_subject}[1] > 0.9999", 30)
        page.wait_for(f"Math.abs({to_subject}[0] - {distance}) < 0.01 * {distance}", 30)
        # A link to this view.
        click(page, "Copy link")
        link = page.wait_for("location.hash", 10)
        shown = pose_of([float(number) for number in link.removeprefix("#view=").split(",")])
        page.key("r")
        wait_for_pose(page, pose_of(start[0]))
    with opened(file, 300, 400, link) as page:
        wait_for_pose(page, shown)
        # Another link in the same tab.
        page.evaluate(f"location.hash = '#view={','.join(map(str, stops[5]))}'")
        wait_for_pose(page, pose_of(stops[5]))
        page.key("r")
        # Links that are no views.
        for link in ("#", "#view=1,1,1,1,1,1,50", "#view=a,b,c,d,e,f,g", "#view=0,0,0,1,1,1,0"):
            wait_for_pose(page, pose_of(start[0]))
            page.evaluate(f"location.hash = '{link}'")
        wait_for_pose(page, pose_of(start[0]))


@pytest.mark.browser
def test_windows_of_any_shape_show_the_complete_photo(file, scene):
    """Also if the shape changes, as that of a phone that is turned."""
    component = f"{ENTITY}.camera"
    with opened(file, 480, 360) as page:
        for width, height in ((600, 300), (300, 600), (480, 360)):
            page.resize(width, height)
            camera = scene.start.camera(width, height)
            fov = math.degrees(2 * math.atan(max(width, height) / 2 / camera.fx))
            page.wait_for(f"Math.abs({component}.fov - {fov}) < 0.01", 30)
            assert page.evaluate(f"{component}.horizontalFov") == (width > height)
        # A failure of the loaded page is not shown.
        page.wait_for("window.sse.viewer?.state.loaded", 60)
        failure = "{promise: Promise.resolve(), reason: 'no full screen'}"
        page.evaluate(f"dispatchEvent(new PromiseRejectionEvent('unhandledrejection', {failure}))")
        assert not page.evaluate(f"!!{FAILURE}")


@pytest.mark.browser
def test_a_window_shows_no_more_than_the_photos_do(scene, tmp_path):
    """But always the core of the subject; also after a phone is turned. The page and the poster
    begin with the first photo that has the core, here the fourth."""
    path, views = tmp_path / "limited.html", scene.stops.views
    across, down = scene.start.tangents()  # half of a photo
    seen = [(1.0, 1.5), (1.0, 1.0), (1.25, 1.0), (3.0, 1.0), *[(1.0, 1.0)] * 8]
    held = [(9.0, 9.0)] * 3 + [(across / 2, down / 2)] * 9
    stops = scene.stops._replace(seen=seen, held=held)
    assert first_stop(stops) == 3
    scene = scene._replace(stops=stops, start=stops.view(3), first=3)
    write_html(path, scene)
    shown = f"(c => [c.aspectRatio, Math.tan(c.fov * Math.PI / 360)])({ENTITY}.camera)"
    with opened(path, 600, 300) as page:  # 1.5 times as wide as the photos
        wait_for_pose(page, pose_of(view_numbers(views[3], scene.start.aspect)))
        for i, times in ((2, 1.5), (4, 1.0), (3, 1.5)):
            page.evaluate(f"document.querySelector('.snow-stops').children[{i}].click()")
            wait_for_pose(page, pose_of(view_numbers(views[i], scene.start.aspect)))
            # The third one has a core that is larger than the photo, which is shown then.
            page.wait_for(f"Math.abs({shown}[1] - {times * across}) < 0.01", 30)
            camera = shown_at(stops, i, 600, 300)
            assert 300 / camera.fx == pytest.approx(times * across)
        page.resize(300, 600)
        page.wait_for(f"{shown}[0] < 0.6", 30)
        # The photos show its height only, but the core is as wide as half of it.
        page.wait_for(f"Math.abs({shown}[1] - {across}) < 0.01", 30)
        assert 300 / scene.camera(300, 600).fy == pytest.approx(across)


def test_photos_of_a_room_from_its_middle():
    """They have no subject that a window must hold: the page begins with the first one."""
    random = torch.Generator().manual_seed(0)
    walls = torch.nn.functional.normalize(torch.randn(3000, 3, generator=random), dim=1) * 4
    points = Points(walls, torch.zeros(len(walls), 3, dtype=torch.uint8))
    cameras = []
    for turn in range(6):
        sine, cosine = math.sin(turn), math.cos(turn)
        rotation = [[cosine, 0.0, -sine, 0.0], [0.0, 1.0, 0.0, 0.0], [sine, 0.0, cosine, -0.1]]
        pose = torch.tensor(rotation, dtype=torch.float64)
        cameras.append(Camera(80, 60, 60.0, 60.0, 40.0, 30.0, pose))
    scene = ready(Gaussians.from_points(points), cameras)
    assert scene.first == 0
    assert scene.stops.held == [(0.0, 0.0)] * 6
    assert scene.camera(60, 120).fy >= scene.start.camera(60, 120).fy


def test_what_photos_show_beside_a_photo():
    """A wall at z = 4, which photos from x = −1, 0 and 1 show; its parts are counted by angles."""
    wall = torch.cartesian_prod(torch.linspace(-9, 9, 91), torch.linspace(-9, 9, 91))
    means = torch.cat([wall, torch.full((len(wall), 1), 4.0)], 1)
    gaussians = replace(
        Gaussians.from_points(Points(means, torch.zeros(len(means), 3, dtype=torch.uint8))),
        opacity_logits=torch.full((len(means),), 5.0),
    )
    pose = torch.eye(3, 4, dtype=torch.float64)
    cameras = []
    for x in (0.0, -1.0, 1.0):
        there = pose.clone()
        there[0, 3] = -x
        cameras.append(Camera(80, 60, 80.0, 80.0, 40.0, 30.0, there))
    first = stops_of(gaussians, cameras, 4.0, (0.0, 0.0, 0.0)).seen[0]
    # The photo is 4 wide and 3 high there; the photos beside it show 1 more on each side.
    assert first[0] == pytest.approx(1.0 + 2.0 / 4.0 / 0.85, abs=0.1)
    assert first[1] == pytest.approx(1.0, abs=0.1)


@pytest.mark.browser
def test_the_texts_are_chinese_in_a_browser_in_chinese(file, scene):
    with Browser(600, 400, 0.25, frames=5.0) as browser:
        page = browser.open(f"{file.as_uri()}?webgl", language="zh-CN")
        page.wait_for("!!document.querySelector('.snow-panel')", 60)
        click(page, "照片")
        click(page, "清理")
        text = page.evaluate("document.querySelector('.snow-panel').innerText")
        assert text.startswith("Balls <&>")
        assert re.search(r"[0-9] 个高斯 · 2026-11-24 · CC0", text)
        assert not re.search(r"[A-Za-z]", text.replace("Balls <&>", "").replace("CC0", ""))
        assert page.evaluate("document.querySelector('.sse-settings').ariaLabel") == "设置"
        page.navigate(f"{file.as_uri()}?webgl&lang=en#view=1,2,3")
        page.wait_for("!!document.querySelector('.snow-panel')", 60)
        assert "Clean up" in page.evaluate("document.querySelector('.snow-panel').innerText")
        page.wait_for("!!window.app", 60)
        wait_for_pose(page, pose_of(view_numbers(scene.start, scene.start.aspect)))
        assert not page.errors


@pytest.mark.browser
def test_a_browser_that_is_too_old_is_told_so(file):
    no_webgl = "HTMLCanvasElement.prototype.getContext = () => null"
    no_modules = "delete HTMLScriptElement.prototype.noModule"
    with Browser(600, 400, 0.25, frames=5.0) as browser:
        for lacks, asked in ((no_webgl, ""), (no_webgl, "?webgl"), (no_modules, "")):
            page = browser.open("about:blank")
            page.call("Page.addScriptToEvaluateOnNewDocument", source=lacks)
            page.navigate(f"{file.as_uri()}{asked}")
            told = page.wait_for(FAILURE)
            if lacks == no_modules:
                assert told.startswith("This browser is too old")
                continue
            assert told.startswith("This browser has no WebGL 2")
            assert "请使用其他浏览器" in told
            assert any("WebGL not supported" in error for error in page.errors)


@pytest.mark.browser
def test_a_click_on_every_control(file):
    """Leaves no error in the console. The film is the last one; dragging ends it in orbit."""
    with opened(file, 600, 400) as page:
        # The keyboard reaches hidden controls and the switches, whose keys are not for the film.
        page.evaluate("window.sse.viewer.state.controlsHidden = true")
        page.key("Tab")
        assert page.evaluate("!!document.activeElement.closest('.sse-controlsWrap')")
        switch = "document.querySelector('.sse-performanceModeCheck')"
        page.evaluate(f"document.querySelector('.sse-settings').click(), {switch}.focus()")
        before = page.evaluate(f"{switch}.ariaChecked")
        page.key(" ")
        page.wait_for(f"{switch}.ariaChecked !== '{before}'")
        assert page.evaluate(MODE) == "orbit"
        shown = "[...document.querySelectorAll('.sse-viewer button')].filter(b => b.offsetParent)"
        clicked = set()
        while True:
            # Buttons of panels are the last ones. A click on another button may hide them.
            names = page.evaluate(f"{shown}.map(b => b.classList[0] || b.innerText || b.ariaLabel)")
            new = [name for name in names if name not in clicked and name != "sse-play"]
            if not new:
                break
            clicked.add(new[-1])
            page.evaluate(f"{shown}[{names.index(new[-1])}].click()")
        assert {"Photos", "Clean up", "Copy link", "Photo 12 / 12"} <= clicked
        # A screen reader has a name for each.
        unnamed = "b => !b.ariaLabel && !b.textContent.trim()"
        buttons = "[...document.querySelectorAll('.sse-viewer button')]"
        assert page.evaluate(f"{buttons}.filter({unnamed}).map(b => b.className)") == []
        named = ("flyCamera", "settings", "frame", "reset", "controlsButton", "info", "infoClose")
        assert {f"sse-{name}" for name in named} <= clicked
        for key in "12ghfr":
            page.key(key)
        page.evaluate("document.querySelector('.sse-orbitCamera').click()")
        page.evaluate("document.querySelector('.sse-play').click()")
        assert page.evaluate(MODE) == "anim"
        # The fly mode has asked for the pointer; the browser may grant it late.
        page.evaluate("document.exitPointerLock()")
        page.wait_for("!document.pointerLockElement")
        page.drag(300, 315, 380, 325)  # below the pictures
        page.wait_for(f"{MODE} === 'orbit'", 30)
