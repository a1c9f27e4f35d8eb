"""The page in real Chromium during a training run: its images and its controls.

Training takes much processor time. Therefore, the tests share a tab, and the training is paused
between them.
"""

import json
import math
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from snowsplat.scene.camera_json import read_cameras
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.hosts import listen

from ...browser import Browser, Page
from ...fork_server import popen
from ...ports import unused_port
from ...waiting import wait_until

pytestmark = pytest.mark.browser

SCALE = 0.25  # a sixteenth of the pixels
STATUS = "document.getElementById('status').innerText"
WHERE = "document.getElementById('where').innerText"
PAUSED = f"{STATUS}.includes(', paused')"
LOADED = f"/Step [1-9]/.test({STATUS}) && document.getElementById('notice').hidden"
NOWHERE = f"{WHERE}.startsWith('Click a camera')"
# Keeps what the page sends.
RECORD = """(() => { window.sent = []; const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (text) {
    window.sent.push(JSON.parse(text)); window.socket = this; send.call(this, text); }; })()"""


class Training:
    """A training run in a separate process, with a page."""

    def __init__(self, dataset: Path, out: Path) -> None:
        port = unused_port()
        self.lines, self.out = [], out
        flags = ["--iterations", "500000", "--threads", "1", "--view", "--port", str(port)]
        command = ("-m", "snowsplat", "train", dataset, "-o", out, "--eval", *flags)
        self.process = popen(*command, stderr=subprocess.STDOUT)
        while not self.lines or not self.lines[-1].startswith("step"):
            line = self.process.stdout.readline()
            assert line, self.lines
            self.lines.append(line)
            if line.startswith("watch it in a browser: "):
                self.url = line.split()[-1]

    def interrupt(self) -> str:
        """Send Ctrl-C; returns the following output."""
        self.process.send_signal(signal.SIGINT)
        out, _ = self.process.communicate(timeout=60)
        return out


@pytest.fixture(scope="module")
def training(tmp_path_factory, browser) -> Iterator[Training]:
    """It starts after the browser, since it uses the processor all the time."""
    root = tmp_path_factory.mktemp("page")
    dataset = write_toy_dataset(root / "dataset", "colmap-bin", 9, 96, 72, n_points=600)
    training = Training(dataset, root / "out")
    yield training
    if training.process.poll() is None:
        training.process.kill()
        training.process.communicate()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(800, 480, SCALE, frames=5.0) as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(training, browser) -> Page:
    page = browser.open(training.url)
    page.wait_for(LOADED)
    page.evaluate(RECORD)
    return page


@pytest.fixture(scope="module")
def other(training, browser, tab) -> Page:
    """A second page; the tests that use it come first, and the last of them closes it."""
    page = browser.open(training.url)
    page.wait_for(LOADED)
    return page


@pytest.fixture
def page(tab) -> Iterator[Page]:
    yield tab
    pause(tab)


def press(page: Page, name: str) -> None:
    """Press the button, or tick the box, of this id."""
    page.evaluate(f"document.getElementById('{name}').click()")


def pause(page: Page) -> None:
    """Pause the training unless it is paused already."""
    if not page.evaluate(PAUSED):
        press(page, "pause")
        page.wait_for(PAUSED)


def resume(page: Page) -> None:
    """Resume the training if it is paused."""
    if page.evaluate(PAUSED):
        press(page, "pause")
        page.wait_for("!" + PAUSED)


def put(page: Page, name: str, value: object) -> None:
    """Set the list or the slider of this id, as a user does."""
    page.evaluate(
        f"(() => {{ const e = document.getElementById('{name}'); e.value = '{value}';"
        "e.dispatchEvent(new Event('input')); e.dispatchEvent(new Event('change')); })()"
    )


def sent(page: Page, kind: str) -> dict[str, Any]:
    """The newest message of this type that the page has sent."""
    found = f"JSON.stringify(window.sent.filter(m => m.type === '{kind}').pop() ?? null)"
    return json.loads(page.evaluate(found))


def step_of(page: Page) -> int:
    text = page.evaluate(STATUS)
    return int(re.search(r"Step ([\d,]+) of 500,000", text)[1].replace(",", ""))


def scene(page: Page) -> np.ndarray:
    """The part of the screenshot left of the controls and below the messages of the browser."""
    return page.screenshot()[int(100 * SCALE) :, : int(300 * SCALE)].astype(int)


def differ(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())


def drag(page: Page, moved: Callable[[], bool]) -> None:
    """Drag the scene until ``moved`` is true: on a busy machine, Chromium may lose a drag."""
    for _ in range(3):
        page.drag(100, 240, 220, 280)
        end = time.monotonic() + 10
        while time.monotonic() < end:
            if moved():
                return
            time.sleep(0.1)
    raise AssertionError("the camera did not move")


def settled(page: Page) -> np.ndarray:
    """The scene when it no longer changes."""
    before = scene(page)
    for _ in range(40):
        time.sleep(0.4)
        now = scene(page)
        if differ(before, now) < 0.05:
            return now
        before = now
    raise AssertionError("the image did not become still")


def test_the_page_shows_a_running_training_run(training, page):
    lines = "".join(training.lines)
    assert f"watch it in a browser: {training.url}\n" in lines
    first = step_of(page)
    wait_until(lambda: scene(page).std() > 10)  # a picture, not one colour
    wait_until(lambda: step_of(page) > first + 10)
    page.wait_for("document.querySelectorAll('figure:not([hidden]) polyline').length === 2")
    assert "Gaussians, loss 0." in page.evaluate(STATUS)
    assert page.errors == []
    outside = [url for url in page.requests if not url.startswith(training.url)]
    assert [url for url in outside if not url.startswith(("data:", "blob:"))] == []


def test_two_pages_have_separate_cameras(page, other):
    """It comes before the tests that move the camera of the first page."""
    pause(page)
    other.wait_for(PAUSED)
    here, there = settled(page), settled(other)
    assert differ(here, there) < 1
    drag(other, lambda: differ(scene(other), there) > 2)
    assert differ(settled(page), here) < 1
    put(other, "mode", "depth")
    assert differ(settled(page), here) < 1
    paused = step_of(page)
    press(other, "pause")  # the training is shared
    wait_until(lambda: step_of(page) > paused)


def test_a_page_that_closes_during_a_transfer(training, page, other):
    first = step_of(page)
    closings = (lambda: other.navigate(training.url), other.close)
    for close in closings:
        other.wait_for(LOADED)
        resume(other)
        other.drag(100, 240, 300, 340, steps=30)
        close()
        assert training.process.poll() is None
        pause(page)
    resume(page)
    wait_until(lambda: step_of(page) > first + 10)
    assert training.process.poll() is None


def test_pause_step_and_resume(page):
    resume(page)
    pause(page)
    paused = step_of(page)
    still = settled(page)
    time.sleep(1.5)
    assert step_of(page) == paused
    press(page, "step")
    wait_until(lambda: step_of(page) == paused + 1)
    # While paused, the camera can still be moved.
    drag(page, lambda: differ(scene(page), still) > 2)
    assert differ(settled(page), still) > 2
    press(page, "pause")
    wait_until(lambda: step_of(page) > paused + 10)


def test_display_modes(page):
    pause(page)
    seen = [settled(page)]
    for name in ("depth", "alpha", "normals", "points", "ellipsoids", "cost"):
        put(page, "mode", name)
        wait_until(lambda: differ(scene(page), seen[-1]) > 1)
        seen.append(settled(page))
        assert page.evaluate("document.getElementById('legend').innerText")
    put(page, "mode", "color")
    # On a busy machine, the first image may be one of those with a low resolution, which the
    # server sends before the sharp one.
    others = min(differ(seen[0], mode) for mode in seen[1:])
    wait_until(lambda: differ(scene(page), seen[0]) < others / 3)
    put(page, "size", 20)
    put(page, "degree", 0)
    wait_until(lambda: differ(scene(page), seen[0]) > 1)
    put(page, "size", 100)
    put(page, "degree", 3)
    wait_until(lambda: differ(scene(page), seen[0]) < others / 3)
    page.evaluate("document.querySelectorAll('.range input')[0].step = 'any'")
    slider = "document.querySelectorAll('.range input')[0]"
    page.evaluate(f"{slider}.value = {slider}.max, {slider}.dispatchEvent(new Event('input'))")
    wait_until(lambda: differ(scene(page), seen[0]) > 1)
    low, high = sent(page, "display")["crop"]
    assert low[0] == high[0]  # the ends do not pass each other
    press(page, "cropped")
    wait_until(lambda: differ(scene(page), seen[0]) < others / 3)


def test_the_view_at_a_photo(page):
    resume(page)
    wait_until(lambda: step_of(page) > 300)  # similar to the photo
    pause(page)
    put(page, "mode", "error")
    page.wait_for("document.getElementById('legend').innerText.startsWith('Only at')")
    press(page, "next")
    first = photo_of(page)
    assert first is not None
    error = settled(page)
    put(page, "mode", "color")
    wait_until(lambda: differ(scene(page), error) > 1)
    render = settled(page)
    press(page, "photo")
    wait_until(lambda: differ(scene(page), render) > 0.2)
    photo = settled(page)
    assert differ(photo, render) < 30  # it is the same pose
    press(page, "next")
    assert photo_of(page) not in (None, first)
    wait_until(lambda: differ(scene(page), photo) > 1)
    drag(page, lambda: page.evaluate(NOWHERE))
    assert page.evaluate("document.getElementById('compare').hidden")
    press(page, "render")


def test_a_click_on_a_camera(page):
    """The cameras are drawn where they are in the image; a click goes to the photo."""
    press(page, "frustums")
    press(page, "next")
    page.evaluate("document.getElementById('stage').focus()")
    type_key(page, "f", "KeyF", lambda: page.evaluate(NOWHERE))
    drawn = (
        "[...document.getElementById('cameras').getContext('2d').getImageData(0, 0, 400, 400).data]"
        ".filter((v, i) => i % 4 == 3 && v > 9).length"
    )
    wait_until(lambda: page.evaluate(drawn) > 4)
    settled(page)
    view = sent(page, "view")
    photos = page.evaluate(
        "new Promise(done => { const s = new WebSocket(location.href.replace('http', 'ws') + 'live');"  # noqa: E501
        "s.onmessage = ({data}) => { if (typeof data === 'string' && data.includes('photos'))"
        "{ s.close(); done(data); } } })"
    )
    position = np.array(json.loads(photos)["photos"][2]["position"])
    right, down, ahead = axes(view["quat"]).T
    offset = position - view["position"]
    depth = offset @ ahead
    width, height = page.evaluate("[stage.clientWidth, stage.clientHeight]")
    focal = height / 2 / math.tan(view["fov"] / 2)
    x, y = focal * (offset @ right) / depth, focal * (offset @ down) / depth
    page.click(width / 2 + x, height / 2 + y)
    wait_until(lambda: photo_of(page) is not None)
    wait_until(lambda: sent(page, "view")["photo"] is not None)
    shown = sent(page, "view")
    assert np.linalg.norm(np.array(shown["position"]) - position) < 1e-5
    press(page, "frustums")


def axes(quat: list[float]) -> np.ndarray:
    """(3, 3): the columns are right, down and ahead."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def moved(page: Page, act: Callable[[], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The views before and after the first movement of ``act``, which may be lost."""
    before = sent(page, "view")
    for _ in range(3):
        act()
        end = time.monotonic() + 5
        while time.monotonic() < end:
            after = sent(page, "view")
            if after["position"] != before["position"] or after["quat"] != before["quat"]:
                time.sleep(0.5)
                return before, sent(page, "view")
            time.sleep(0.1)
    raise AssertionError("the camera did not move")


def test_mouse_touch_and_keys_move_the_camera(page):
    page.evaluate("document.getElementById('stage').focus()")
    type_key(page, "n", "KeyN", lambda: photo_of(page) is not None)
    type_key(page, "r", "KeyR", lambda: page.evaluate(NOWHERE))
    start = sent(page, "view")

    def touch(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y} for x, y in points]
        page.call("Input.dispatchTouchEvent", type=kind, touchPoints=places)

    def one_finger() -> None:
        touch("touchStart", (200, 200))
        for x in range(200, 300, 20):
            touch("touchMove", (x, 200))
        touch("touchEnd")

    def pinch() -> None:
        touch("touchStart", (200, 200), (240, 200))
        for x in range(0, 100, 20):
            touch("touchMove", (200 - x, 200), (240 + x, 200))
        touch("touchEnd")

    # To turn: all directions of view meet in the same point, and the horizon stays level.
    views = [start]
    across = lambda: page.drag(200, 200, 320, 200)  # noqa: E731
    down = lambda: page.drag(200, 200, 200, 260)  # noqa: E731
    for act in (across, down, one_finger):
        views.append(moved(page, act)[1])
    level = axes(views[0]["quat"])[:, 0]
    normal = np.cross(level, axes(views[1]["quat"])[:, 0])
    normal /= np.linalg.norm(normal)
    rays = [(np.array(v["position"]), axes(v["quat"])[:, 2]) for v in views]
    matrix = sum(np.eye(3) - np.outer(d, d) for _, d in rays)
    vector = sum((np.eye(3) - np.outer(d, d)) @ p for p, d in rays)
    target = np.linalg.solve(matrix, vector)
    distances = [np.linalg.norm(target - p) for p, _ in rays]
    for view, (place, ahead) in zip(views, rays, strict=True):
        off = target - place - ((target - place) @ ahead) * ahead
        assert np.linalg.norm(off) < 1e-3 * distances[0]
        assert abs(axes(view["quat"])[:, 0] @ normal) < 1e-3
    assert np.ptp(distances) < 1e-3 * distances[0]
    # To zoom: along the direction of view.
    wheel = {"type": "mouseWheel", "x": 200, "y": 200, "deltaX": 0, "deltaY": -200}
    for act in (lambda: page.call("Input.dispatchMouseEvent", **wheel), pinch):
        before, after = moved(page, act)
        by = np.array(after["position"]) - before["position"]
        ahead = axes(before["quat"])[:, 2]
        assert by @ ahead > 0.9 * np.linalg.norm(by)
        assert np.allclose(before["quat"], after["quat"], atol=1e-5)

    def right_drag() -> None:
        for kind, x in (("mousePressed", 200), ("mouseMoved", 260), ("mouseReleased", 260)):
            page.call("Input.dispatchMouseEvent", type=kind, x=x, y=200, button="right", buttons=2)

    before, after = moved(page, right_drag)
    by = np.array(after["position"]) - before["position"]
    assert by @ axes(before["quat"])[:, 0] < -0.99 * np.linalg.norm(by)

    def fly() -> None:
        page.call("Input.dispatchKeyEvent", type="keyDown", key="w", code="KeyW")
        time.sleep(0.6)
        page.call("Input.dispatchKeyEvent", type="keyUp", key="w", code="KeyW")

    before, after = moved(page, fly)
    by = np.array(after["position"]) - before["position"]
    assert by @ axes(before["quat"])[:, 2] > 0.99 * np.linalg.norm(by)
    assert np.allclose(before["quat"], after["quat"], atol=1e-5)


def type_key(page: Page, key: str, code: str, done: Callable[[], bool]) -> None:
    """Type a key until ``done`` is true: with few images per second, Chromium may lose a key."""
    for _ in range(6):
        page.key(key, code=code)
        until = time.monotonic() + 10
        while time.monotonic() < until:
            if done():
                return
            time.sleep(0.2)
    raise AssertionError(f"the key {key} has no effect")


def photo_of(page: Page) -> str | None:
    found = re.search(r"view_\d\d\.png", page.evaluate(WHERE))
    return found and found[0]


def test_keys(page):
    pause(page)
    page.evaluate("document.getElementById('stage').focus()")
    type_key(page, "n", "KeyN", lambda: photo_of(page) is not None)
    first = photo_of(page)
    at_photo = settled(page)
    type_key(page, "p", "KeyP", lambda: photo_of(page) not in (None, first))
    assert differ(settled(page), at_photo) > 1
    # The whole scene.
    type_key(page, "f", "KeyF", lambda: page.evaluate(NOWHERE))
    framed = settled(page)
    type_key(page, "r", "KeyR", lambda: differ(scene(page), framed) > 1)
    colour = "getComputedStyle(document.body).backgroundColor"
    before = page.evaluate(colour)
    type_key(page, "l", "KeyL", lambda: page.evaluate(colour) != before)
    type_key(page, "l", "KeyL", lambda: page.evaluate(colour) == before)
    paused = step_of(page)
    type_key(page, " ", "Space", lambda: step_of(page) > paused)


def test_both_languages(page):
    """All texts exist in both; the page changes completely."""
    names = page.evaluate(
        "import('./texts.js').then(m => Object.values(m.TEXTS).map(t => '' + Object.keys(t)))"
    )
    assert names[0] == names[1]
    english = page.evaluate("document.body.innerText")
    press(page, "language")
    chinese = page.evaluate("document.body.innerText")
    assert page.evaluate("document.documentElement.lang") == "zh-CN"
    left = {"English", "PSNR"} | set(re.findall(r"[A-Za-z]{4,}", page.evaluate("document.title")))
    assert set(re.findall(r"[A-Za-z]{4,}", chinese)) <= left
    press(page, "language")
    assert page.evaluate("document.body.innerText").split("\n")[0] == english.split("\n")[0]
    unnamed = (
        "[...document.querySelectorAll('button, input, select')].filter(e => "
        "!e.hasAttribute('aria-label') && !e.textContent.trim() && !e.closest('label')).length"
    )
    assert page.evaluate(unnamed) == 0


def test_it_reconnects_by_itself(page):
    pause(page)
    before = settled(page)
    put(page, "mode", "depth")
    wait_until(lambda: differ(scene(page), before) > 1)
    depth = settled(page)
    count = "window.sent.filter(m => m.type === 'display').length"
    settings = page.evaluate(count)
    page.evaluate("window.socket.close()")
    page.wait_for("!document.getElementById('notice').hidden")
    page.wait_for("document.getElementById('notice').hidden")
    assert page.evaluate(count) > settings
    assert differ(settled(page), depth) < 2
    put(page, "mode", "color")


def test_views_are_stored_for_a_video(page, tmp_path):
    page.evaluate(
        "(() => { const make = URL.createObjectURL; URL.createObjectURL = "
        "blob => { if (blob.type.includes('json')) window.kept = blob; "
        "return make.call(URL, blob); }; })()"
    )
    before = settled(page)
    stored = "document.getElementById('stored').textContent.includes('{} stored')"
    press(page, "store")
    page.wait_for(stored.format(1))
    drag(page, lambda: differ(scene(page), before) > 2)
    press(page, "store")
    page.wait_for(stored.format(2))
    press(page, "download")
    page.wait_for("!!window.kept")
    (tmp_path / "cameras.json").write_text(page.evaluate("window.kept.text()"))
    names, cameras = read_cameras(tmp_path / "cameras.json")
    assert names == ["key_000", "key_001"]
    assert float((cameras[0].position - cameras[1].position).norm()) > 0.01
    press(page, "remove")
    page.wait_for(stored.format(1))


def test_ctrl_c_while_paused_saves_and_closes(training, tab):
    pause(tab)
    paused = step_of(tab)
    out = training.interrupt()
    assert training.process.returncode == 130
    assert f"stopped after step {paused}" in out
    assert "Traceback" not in out
    assert "warning" not in out
    assert (training.out / f"point_cloud/iteration_{paused}/point_cloud.ply").is_file()
    tab.close()
    listen("127.0.0.1", urlsplit(training.url).port).close()
