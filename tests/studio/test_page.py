"""The page in a real browser: by clicks, from an empty page to a downloaded file."""

import shutil
import sys
import zipfile
from urllib.parse import quote

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.studio import job

from ..browser import Browser, Page
from ..sfm.colmap import scenes
from .conftest import of_the_command_line

# The worker, with shorter trainings: `make` would take at least 15 seconds for one.
_HURRIED = """
import shutil
import sys
from snowsplat.pipeline import make
from snowsplat.studio.__main__ import main
make._MIN_SECONDS = 6.0
sys.exit(main(sys.argv[1:]))
"""

pytestmark = [pytest.mark.browser, pytest.mark.sfm]


def click(page: Page, text: str, within: str = "main") -> None:
    """Click the button with this text."""
    page.evaluate(
        f"[...document.querySelectorAll('{within} button')]"
        f".find(each => each.textContent === {text!r}).click()"
    )


def test_from_photos_to_a_file(studio, forked, tmp_path, monkeypatch):
    """The browser is closed and the job is killed on the way; nothing is lost."""
    monkeypatch.setattr(job, "_WORKER", [sys.executable, "-c", _HURRIED])
    photos = scenes.write_photos(tmp_path / "Häuser am See", 9)
    asked: set[str] = set()
    with Browser(1280, 800, frames=2.0) as browser:
        page = browser.open(studio.server.url)
        page.wait_for("!!document.querySelector('.drop')")
        page.drop(photos)
        page.wait_for("!!document.querySelector('form.card:not([hidden]) .main')", 120)
        assert page.evaluate("document.querySelector('.facts dd').textContent") == "9"
        assert page.evaluate("document.querySelector('h1').textContent") == "Häuser am See"
        page.evaluate(
            "(() => { const form = document.querySelector('form.card');"
            "form.querySelector('input[type=text]').value = 'My tour';"
            "form.querySelector('input[type=number]').focus();"
            "form.querySelector('input[type=number]').value = '0.1'; })()"
        )
        click(page, "Make the scene")
        page.wait_for("!!document.querySelector('.stages li[data-state=now]')", 60)
        (scene,) = studio.library.scenes()
        hash_ = page.evaluate("location.hash")
    job._started[scene.lock()].kill()
    job._started[scene.lock()].wait()
    with Browser(1280, 800, frames=2.0) as browser:
        page = browser.open(studio.server.url + hash_)
        page.wait_for("document.querySelector('.status')?.dataset.status === 'interrupted'", 30)
        click(page, "Continue")
        page.wait_for("!!document.querySelector('iframe.viewer:not([hidden])')", 180)
        # Images of the running training arrive.
        page.wait_for("!!document.querySelector('iframe.viewer').contentDocument?.body", 30)
        page.wait_for("document.querySelector('.status').dataset.status === 'done'", 240)
        page.wait_for("!!document.querySelector('iframe.viewer').contentWindow?.app", 90)
        click(page, "SPZ")
        file = scene.exports / "My tour.spz"
        page.wait_for("!document.querySelector('.export button:disabled')", 60)
        assert len(read_gaussians(file)) > 100
        page.evaluate("document.querySelector('[aria-label=\"Download ZIP\"]').focus()")
        page.key("Enter")
        page.wait_for("!document.querySelector('.export button:disabled')", 60)
        assert page.evaluate("document.activeElement.textContent") == "ZIP"  # not lost
        assert "index.html" in zipfile.ZipFile(scene.exports / "My tour.zip").namelist()
        click(page, "glTF (mesh)")
        page.wait_for("!document.querySelector('.export button:disabled')", 60)
        assert (scene.exports / "My tour_mesh.glb").read_bytes()[:4] == b"glTF"
        asked |= set(
            page.evaluate("performance.getEntriesByType('resource').map(each => each.name)")
        )
        page.evaluate("document.querySelector('#language').click()")
        page.wait_for("document.documentElement.lang === 'zh'")
        page.wait_for("document.querySelector('.status')?.firstChild?.textContent === '已完成'", 30)
        page.evaluate("document.querySelector('.brand').click()")
        page.wait_for("document.querySelector('.tile b')?.textContent === 'My tour'", 30)
        assert not page.errors
    assert all(name.startswith(studio.server.url) for name in asked)
    assert studio.ask(f"scenes/{quote(scene.name)}")[1]["state"]["result"]["psnr"] > 15


def test_a_scene_of_the_command_line_is_seen(studio, forked):
    of_the_command_line(studio.library.folder / "tour")
    with Browser(1280, 800, frames=2.0) as browser:
        page = browser.open(studio.server.url + "#tour")
        page.wait_for("!!document.querySelector('.viewer')", 60)
        assert "50" in page.evaluate("document.querySelector('.figures').textContent")
        assert not page.errors


def test_what_the_photos_are_in_chinese(studio, forked, tmp_path):
    photos = scenes.write_photos(tmp_path / "photos", 4)
    shutil.copy(next(photos.iterdir()), photos / "zz.png")
    (photos / "broken.jpg").write_bytes(b"no photo")
    with Browser(1280, 800) as browser:
        page = browser.open(studio.server.url, language="zh-CN")
        page.wait_for("!!document.querySelector('.drop')")
        page.drop(photos)
        page.wait_for("!!document.querySelector('form.card:not([hidden]) .main')", 120)
        facts = page.evaluate("document.querySelector('.facts').textContent")
        assert "zz.png: 与 " in facts
        assert "是同一张图片" in facts
        assert "broken.jpg: 无法解码（不是已知格式的图像）" in facts
        warning = "document.querySelector('[role=alert] [data-grade=poor]').textContent"
        assert page.evaluate(warning) == "4 张照片太少"
        page.wait_for("document.querySelectorAll('.given .mark').length === 2", 60)
        marked = "[...document.querySelectorAll('.given button')].slice(0, 2).map(b => b.title)"
        assert set(page.evaluate(marked)) == {"photos/broken.jpg", "photos/zz.png"}
        # A click leaves a photo out, and another one takes it back.
        button = "document.querySelector('.given button[title=\"photos/zz.png\"]')"
        (scene,) = studio.library.scenes()
        for out, folder in (("true", scene.left_out), ("false", scene.photos)):
            page.evaluate(f"{button}.click()")
            page.wait_for(f"{button}.ariaPressed === '{out}' && !{button}.disabled")
            there = [path for path in scene.folder.rglob("zz.png") if path.is_relative_to(folder)]
            assert len(there) == 1
        assert not page.errors


def test_a_text_is_no_scene(studio, tmp_path):
    (tmp_path / "notes.txt").write_text("no photo")
    with Browser(640, 480, frames=2.0) as browser:
        page = browser.open(studio.server.url)
        page.wait_for("!!document.querySelector('.drop')")
        page.drop(tmp_path / "notes.txt")
        page.wait_for("document.getElementById('notice').textContent.includes('drop photos')")
    assert studio.ask("scenes") == (200, [])


def test_a_finished_scene_is_opened_in_place_of_photos(studio, forked, tmp_path):
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    given = tmp_path / "chair.spz"
    write_gaussians(given, gaussians_in_box(box, 60, torch.Generator().manual_seed(0), 1))
    with Browser(1280, 800, frames=2.0) as browser:
        page = browser.open(studio.server.url)
        page.wait_for("!!document.querySelector('.drop')")
        page.drop(given)
        page.wait_for("document.querySelector('.status')?.dataset.status === 'done'", 120)
        page.wait_for("!!document.querySelector('.exports')")
        assert page.evaluate("document.querySelector('h1').textContent") == "chair"
        assert "60" in page.evaluate("document.querySelector('.figures').textContent")
        assert not page.errors
    assert len(read_gaussians(studio.library.folder / "chair/made/chair.ply")) == 60
