"""The page in real Chromium during a training run: its images and its controls.

Loading the page and training take much processor time. Therefore, the tests share a tab, and the
training is paused between them.
"""

import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from snowsplat.scene.camera_json import read_cameras
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live.server import free_port

from ...browser import Browser, Page
from ...fork_server import popen
from ...ports import unused_port

pytestmark = pytest.mark.browser

SCALE = 0.25  # a sixteenth of the pixels
PAUSED = "document.body.innerText.includes(', paused')"
LOADED = "/Step [1-9]/.test(document.body.innerText)"
AT = re.compile(r"At view_\d\d\.png")
BUTTON = "[...document.querySelectorAll('button')].find(b => b.innerText.trim() === '{}')"


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
    with Browser(640, 480, SCALE, frames=5.0) as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(training, browser) -> Page:
    page = browser.open(training.url)
    page.wait_for(LOADED)
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
    page.wait_for("!!" + BUTTON.format(name))
    page.evaluate(BUTTON.format(name) + ".click()")


def pause(page: Page) -> None:
    """Pause the training unless it is paused already."""
    if not page.evaluate(PAUSED):
        press(page, "Pause")
        page.wait_for(PAUSED)


def resume(page: Page) -> None:
    """Resume the training if it is paused."""
    if page.evaluate(PAUSED):
        press(page, "Resume")
        page.wait_for("!" + PAUSED)


def choose(page: Page, now: str, name: str) -> None:
    """Choose the entry ``name`` of the list that shows ``now``."""
    box = "[...document.querySelectorAll('input')].find(i => i.value === '{}')"
    page.wait_for("!!" + box.format(now))
    page.evaluate(f"(() => {{ const i = {box.format(now)}; i.focus(); i.click(); }})()")
    option = f"[...document.querySelectorAll('[role=option]')].find(o => o.innerText === '{name}')"
    page.wait_for("!!" + option)
    page.evaluate(option + ".click()")
    page.wait_for("!!" + box.format(name))


def step_of(page: Page) -> int:
    text = page.evaluate("document.body.innerText")
    return int(re.search(r"Step ([\d,]+) of 500,000", text)[1].replace(",", ""))


def scene(page: Page) -> np.ndarray:
    """The part of the screenshot left of the controls and below the messages of the browser."""
    return page.screenshot()[int(100 * SCALE) :, : int(300 * SCALE)].astype(int)


def differ(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())


def wait(true: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)


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
    wait(lambda: scene(page).std() > 10)  # a picture, not one colour
    wait(lambda: step_of(page) > first + 10)
    wait(lambda: "PSNR (dB)" in page.evaluate("document.body.innerText"))
    text = page.evaluate("document.body.innerText")
    assert "Gaussians, loss 0." in text
    assert page.evaluate("document.querySelectorAll('.uplot canvas').length") == 2
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
    choose(other, "Colour", "Depth")
    assert differ(settled(page), here) < 1
    paused = step_of(page)
    press(other, "Resume")  # the training is shared
    wait(lambda: step_of(page) > paused)


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
    wait(lambda: step_of(page) > first + 10)
    assert training.process.poll() is None


def test_pause_step_and_resume(page):
    resume(page)
    pause(page)
    paused = step_of(page)
    still = settled(page)
    time.sleep(1.5)
    assert step_of(page) == paused
    press(page, "One step")
    wait(lambda: step_of(page) == paused + 1)
    # While paused, the camera can still be moved.
    drag(page, lambda: differ(scene(page), still) > 2)
    assert differ(settled(page), still) > 2
    press(page, "Resume")
    wait(lambda: step_of(page) > paused + 10)


def test_display_modes(page):
    pause(page)
    before, seen = "Colour", [settled(page)]
    for name in ("Depth", "Normals", "Points", "Ellipsoids", "Gaussians per pixel"):
        choose(page, before, name)
        wait(lambda: differ(scene(page), seen[-1]) > 1)
        seen.append(settled(page))
        before = name
    choose(page, before, "Colour")
    # On a busy machine, the first image may be one of those with a low resolution, which the
    # server sends before the sharp one.
    others = min(differ(seen[0], mode) for mode in seen[1:])
    wait(lambda: differ(scene(page), seen[0]) < others / 3)


def test_the_view_at_a_photo(page):
    resume(page)
    wait(lambda: step_of(page) > 300)  # similar to the photo
    pause(page)
    press(page, "Next")
    page.wait_for("document.body.innerText.includes('At view_01.png')")
    render = settled(page)
    press(page, "Photo")
    wait(lambda: differ(scene(page), render) > 0.2)
    photo = settled(page)
    assert differ(photo, render) < 30  # it is the same pose
    press(page, "Next")
    page.wait_for("document.body.innerText.includes('At view_02.png')")
    wait(lambda: differ(scene(page), photo) > 1)
    nowhere = "document.body.innerText.includes('click one to view the scene')"
    drag(page, lambda: page.evaluate(nowhere))


def type_key(page: Page, key: str, code: str, done: Callable[[], bool]) -> None:
    """Type a key until ``done`` is true: with few images per second, Chromium may lose a key."""
    for _ in range(6):
        for kind in ("keyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key=key, code=code)
        until = time.monotonic() + 10
        while time.monotonic() < until:
            if done():
                return
            time.sleep(0.2)
    raise AssertionError(f"the key {key} has no effect")


def photo_of(page: Page) -> str | None:
    found = AT.search(page.evaluate("document.body.innerText"))
    return found and found[0]


def test_keys(page):
    pause(page)
    page.drag(100, 240, 101, 240)  # the scene gets the keyboard
    type_key(page, "n", "KeyN", lambda: photo_of(page) is not None)
    assert photo_of(page) == "At view_01.png"
    at_photo = settled(page)
    type_key(page, "p", "KeyP", lambda: photo_of(page) not in (None, "At view_01.png"))
    assert differ(settled(page), at_photo) > 1
    # The whole scene.
    nowhere = "document.body.innerText.includes('click one to view the scene')"
    type_key(page, "f", "KeyF", lambda: page.evaluate(nowhere))
    framed = settled(page)
    type_key(page, "r", "KeyR", lambda: differ(scene(page), framed) > 1)
    scheme = "document.documentElement.dataset.mantineColorScheme"
    assert page.evaluate(scheme) == "dark"
    type_key(page, "l", "KeyL", lambda: page.evaluate(scheme) == "light")
    type_key(page, "l", "KeyL", lambda: page.evaluate(scheme) == "dark")
    paused = step_of(page)
    type_key(page, " ", "Space", lambda: step_of(page) > paused)


def test_views_are_stored_for_a_video(page, tmp_path):
    page.evaluate(
        "(() => { const make = URL.createObjectURL; URL.createObjectURL = "
        "blob => { if (blob.type.includes('json')) window.kept = blob; "
        "return make.call(URL, blob); }; })()"
    )
    before = settled(page)
    press(page, "Store this view")
    page.wait_for("document.body.textContent.includes('1 stored')")
    drag(page, lambda: differ(scene(page), before) > 2)
    press(page, "Store this view")
    page.wait_for("document.body.textContent.includes('2 stored')")
    press(page, "Download the views")
    page.wait_for("!!window.kept")
    (tmp_path / "cameras.json").write_text(page.evaluate("window.kept.text()"))
    names, cameras = read_cameras(tmp_path / "cameras.json")
    assert names == ["key_000", "key_001"]
    assert float((cameras[0].position - cameras[1].position).norm()) > 0.01
    press(page, "Remove the last view")
    page.wait_for("document.body.textContent.includes('1 stored')")


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
    assert free_port("127.0.0.1", urlsplit(training.url).port)
