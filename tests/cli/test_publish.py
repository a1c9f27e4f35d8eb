"""`snowsplat publish`: the files of the web site, the page in a browser, and its errors."""

import contextlib
import functools
import http.server
import re
import shutil
import threading
from html import unescape

import numpy as np
import pytest
import torch
from PIL import Image
from tests.gaussians import gaussians_in_box

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.project.site_folder import SiteFolder

from ..browser import Browser

FILES = ["index.css", "index.js", "poster.jpg", "scene.sog", "viewer-licence.txt"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A file without cameras: a dense box of small Gaussians in random colours."""
    path = tmp_path_factory.mktemp("publish") / "box.ply"
    box = torch.tensor([[-0.3, -0.6, -0.3], [0.3, 0.0, 0.3]])
    write_gaussians(path, gaussians_in_box(box, 1500, torch.Generator(), 1, 0.9))
    return path


@pytest.fixture(scope="module")
def site(scene, tmp_path_factory):
    """The site, written by Python."""
    from snowsplat import PublishOptions, publish

    folder = tmp_path_factory.mktemp("published") / "site"
    options = PublishOptions("A <box>", "CC BY 4.0", "https://example.org/box")
    result = publish(scene, folder, options)
    assert result.gaussians == 1500
    assert result.bytes == sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    return folder


def test_files(site, scene):
    files = SiteFolder(site).scene().parent
    assert {path.name for path in site.iterdir()} == {"index.html", files.name}
    assert sorted(file.name for file in files.iterdir()) == FILES
    assert len(read_gaussians(files / "scene.sog")) == 1500
    poster = np.asarray(Image.open(files / "poster.jpg"))
    assert poster.shape == (630, 1200, 3)
    assert poster[:, 560:640].std() > 20  # the box is in the middle, before a black background
    assert poster[:, :40].max() < 20


def test_a_page_that_trains(dataset, tmp_path, refused, run):
    page = tmp_path / "learn.html"
    told = refused("publish", "--trainable", dataset, "-o", page, "--licence", "CC0")
    assert "--licence: is not for --trainable" in told
    result = run("publish", "--trainable", dataset, "-o", page, "--title", "Balls")
    assert result.code == 0
    assert "9 photos, 300 Gaussians to begin with" in result.err + result.out
    assert "<title>Balls</title>" in page.read_text("utf-8")


def test_without_cameras_nobody_walks(scene, tmp_path, refused):
    assert "needs the cameras" in refused("publish", scene, "-o", tmp_path / "site", "--walk")
    assert not (tmp_path / "site").exists()


def test_page(site):
    text = (site / "index.html").read_text(encoding="utf-8")
    tags = dict(re.findall(r'<meta property="([^"]+)" content="([^"]*)"', text))
    assert unescape(tags["og:title"]) == "A <box>"
    files = SiteFolder(site).scene().parent.name
    assert tags["og:image"] == f"https://example.org/box/{files}/poster.jpg"
    assert tags["og:url"] == "https://example.org/box/"
    assert re.search(r"A scene in 3D: 1,500 Gaussians · \d{4}-\d\d-\d\d · CC BY", text)
    assert "A <box>" not in text
    # The policy is before everything that it restricts, and allows only this site.
    (policy,) = re.findall(r'Content-Security-Policy" content="(.*?)"', text)
    assert text.index("Content-Security-Policy") < min(text.index("<script"), text.index("<link"))
    assert "http" not in policy
    assert "default-src" in policy


@pytest.mark.browser
@pytest.mark.parametrize(
    ("missing", "told"),
    [
        ("", "Browsers do not load this page from disk"),  # opened by a double click
        ("index.js", "A file of this page cannot be loaded"),  # an incomplete upload
        ("scene.sog", "A file of this page cannot be loaded"),
    ],
)
def test_a_site_that_cannot_be_loaded_says_what_to_do(site, tmp_path, missing, told):
    folder = shutil.copytree(site, tmp_path / "site")
    with contextlib.ExitStack() as stack:
        url = (folder / "index.html").as_uri()
        if missing:
            SiteFolder(folder).scene().with_name(missing).unlink()
            url = stack.enter_context(_served(folder))
        page = stack.enter_context(Browser(480, 360)).open(f"{url}?webgl")
        lines = page.wait_for("document.querySelector('.snow-failure')?.innerText").splitlines()
        assert lines[0].startswith(told)
        assert "请" in lines[1]
        # Dark text plate on the page: neither white nor hidden.
        assert len(np.unique(page.screenshot().reshape(-1, 3), axis=0)) > 20


@contextlib.contextmanager
def _served(folder):
    """The address of a folder on a web server that only sends files."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


@pytest.mark.browser
def test_a_static_server_is_enough(site):
    with _served(site) as own, Browser(480, 360) as browser:
        page = browser.open(f"{own}?webgl")
        page.wait_for("!!window.app", 60)
        about = page.evaluate("document.querySelector('.snow-card').innerText")
        assert not page.errors
        assert all(url.startswith((own, f"blob:{own[:-1]}")) for url in page.requests)
    assert about.startswith("A <box>")
    assert "1,500 Gaussians" in about


def test_overwrite(run, refused, scene, tmp_path):
    folder = tmp_path / "a" / "site"
    result = run("publish", scene, "-o", folder)
    assert result.code == 0, result.err
    assert f"{folder}: 1,500 Gaussians" in result.out
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert "<title>box</title>" in text
    assert re.search(r'og:image" content="files-\w+/poster.jpg"', text)
    assert "og:url" not in text
    assert "--overwrite" in refused("publish", scene, "-o", folder)
    assert run("publish", scene, "-o", folder, "--overwrite", "--title", "B").code == 0
    assert "<title>B</title>" in (folder / "index.html").read_text(encoding="utf-8")


def test_a_large_scene_is_published_in_levels(scene, tmp_path, monkeypatch):
    from snowsplat.pipeline import publish as module

    folder = tmp_path / "site"
    module.publish(scene, folder)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_LARGE", 1000)
        result = module.publish(scene, folder, overwrite=True)
    files = [file for file in folder.rglob("*") if file.is_file()]
    assert result.bytes == sum(file.stat().st_size for file in files)
    assert SiteFolder(folder).content().name == "lod-meta.json"
    assert len(read_gaussians(SiteFolder(folder).content())) == 1500
    module.publish(scene, folder, overwrite=True)
    files = SiteFolder(folder).scene().parent
    assert {path.name for path in folder.iterdir()} == {"index.html", files.name}
    assert sorted(file.name for file in files.iterdir()) == FILES


def test_errors(refused, scene, tmp_path):
    assert "needs a scene" in refused("publish")
    assert "add -o FOLDER" in refused("publish", scene)
    assert "no such file" in refused("publish", tmp_path / "absent.ply", "-o", tmp_path / "a")
    assert "is a file" in refused("publish", scene, "-o", scene)
    assert "contains other files" in refused("publish", scene, "-o", scene.parent)
    site = ("publish", scene, "-o", tmp_path / "a")
    assert "--url: 'example.org' is no address" in refused(*site, "--url", "example.org")
    assert "`iteration`" not in refused(*site, "--iteration", 3)
    empty = tmp_path / "empty.ply"
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    nothing = gaussians_in_box(box, 1, torch.Generator()).select(torch.zeros(0).long())
    write_gaussians(empty, nothing)
    assert "contains no Gaussians" in refused("publish", empty, "-o", tmp_path / "b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.ply"]


def test_the_place_of_a_scene_is_said(run, scene, tmp_path):
    far = read_gaussians(scene)
    far.origin = (500_000.0, 5_400_000.0, 300.0)
    write_gaussians(tmp_path / "far.ply", far)
    result = run("publish", tmp_path / "far.ply", "-o", tmp_path / "site")
    assert result.code == 0
    assert "the origin 500000 5400000 300" in result.out + result.err
