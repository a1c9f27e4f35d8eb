"""The self-contained page, opened from disk in a real browser without a network."""

import base64
import json
import re

import numpy as np
import pytest
import torch

from snowsplat.pipeline.output.scene_files import read_gaussians, write_gaussians
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.initial_view import InitialView
from snowsplat.util.errors import UserError
from snowsplat.viewer.web import publication
from snowsplat.viewer.web.scene import ready

from ...browser import Browser


def three_balls() -> Gaussians:
    """Three balls: red left, green above it, blue right, seen from −z with y down."""
    means = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    colors = torch.eye(3)
    return Gaussians(
        means,
        torch.full((3, 3), -2.0),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(3, 1),
        torch.full((3,), 6.0),
        ((colors - 0.5) / SH_C0)[:, None],
        torch.zeros(3, 0, 3),
    )


FRONT = InitialView((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), 60.0, 400 / 300)


def test_the_scene_is_embedded(tmp_path):
    path = tmp_path / "a <b>.html"
    write_gaussians(path, three_balls())
    page = path.read_text(encoding="utf-8")
    assert "<title>a &lt;b&gt;</title>" in page
    (scene,) = re.findall(r'<script type="text/plain" id="scene">(.*?)</script>', page)
    (tmp_path / "scene.sog").write_bytes(base64.b64decode(scene))
    write_gaussians(tmp_path / "site.sog", three_balls())
    assert (tmp_path / "scene.sog").read_bytes() == (tmp_path / "site.sog").read_bytes()
    back = read_gaussians(tmp_path / "scene.sog")
    assert sorted(back.means.round(decimals=2).tolist()) == sorted(three_balls().means.tolist())
    (bootstrap,) = re.findall(r'id="sse-bootstrap">(.*?)</script>', page)
    assert json.loads(bootstrap)["contentFilename"] == "scene.sog"
    assert "./index.js" not in page
    assert "./index.css" not in page
    assert "createViewer({ container" in page
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, "scene.sog", "site.sog"]


def test_html_files_cannot_be_read(tmp_path):
    write_gaussians(tmp_path / "scene.html", three_balls())
    with pytest.raises(UserError, match="HTML files cannot be read; use the scene file"):
        read_gaussians(tmp_path / "scene.html")


def test_the_page_is_listed_among_the_formats_to_write(tmp_path):
    with pytest.raises(UserError, match=r"use one of .*\.html"):
        write_gaussians(tmp_path / "scene.abc", three_balls())


def test_scenes_without_a_page(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="has no Gaussians"):
        write_gaussians(tmp_path / "scene.html", three_balls().select(torch.zeros(0).long()))
    monkeypatch.setattr(publication, "_LARGEST", 100)
    with pytest.raises(UserError, match="too many for one page; decimate"):
        write_gaussians(tmp_path / "scene.html", three_balls())
    assert not list(tmp_path.iterdir())


@pytest.mark.browser
def test_a_real_browser_opens_it_from_disk(tmp_path):
    path = tmp_path / "scene.html"
    publication.write_html(path, ready(three_balls(), ())._replace(start=FRONT))
    with Browser(400, 300) as browser:
        page = browser.open(f"{path.as_uri()}?webgl&noui")
        page.wait_for("!!window.app", 60)
        shown = page.screenshot(tmp_path / "scene.png").astype(float)
        assert not page.errors
        assert all(url.startswith(("file://", "blob:null/")) for url in page.requests)
        # Even injected scripts cannot make network requests.
        refused = "fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused')"
        assert page.evaluate(refused) == "refused"
        assert any("Content Security Policy" in line for line in page.errors)
    # Half the width is 4 tan 30° = 2.31 world units: 86.6 pixels each.
    for channel, (x, y) in enumerate(((200 - 87, 150), (200 - 87, 150 - 87), (200 + 87, 150))):
        ball = shown[y - 4 : y + 4, x - 4 : x + 4].mean((0, 1))
        assert ball[channel] > 200
        assert np.delete(ball, channel).max() < 60
    assert shown[-40:].max() < 10  # the background
