"""The viewer's page: inserted values and the content security policy."""

import base64
import hashlib
import html
import json
import re

import pytest

from snowsplat.scene.initial_view import InitialView
from snowsplat.util.errors import UserError
from snowsplat.viewer.web import viewer_page
from snowsplat.viewer.web.viewer_page import (
    asset,
    content_policy,
    page,
    page_anew,
    panel_script,
    panel_style,
    whole_page,
)
from snowsplat.viewer.web.viewer_settings import settings

HOSTILE = "</script><script>alert(1)</script><!-- <script>"


def bootstrap_of(text: str) -> dict:
    (found,) = re.findall(r'id="sse-bootstrap">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def test_settings_are_in_the_viewers_frame():
    """The viewer rotates scenes by 180° about z."""
    made = settings(InitialView((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 50.0), (0.1, 0.2, 0.3))
    (camera,) = made["cameras"]
    expected = {
        "position": [-1.0, -2.0, 3.0],
        "target": [-4.0, -5.0, 6.0],
        "fov": pytest.approx(50.0),
    }
    assert camera["initial"] == expected
    assert made["background"] == {"color": [0.1, 0.2, 0.3]}


def test_inserted_values_do_not_become_markup():
    for text in (page(HOSTILE, {"x": HOSTILE}), whole_page(HOSTILE, {"x": HOSTILE}, "")):
        assert bootstrap_of(text) == {"x": HOSTILE}
        assert "alert(1)</script>" not in text
        (title,) = re.findall("<title>(.*?)</title>", text)
        assert html.unescape(title) == HOSTILE


def test_a_page_anew_has_only_the_values():
    text = page("scene", {"panel": {"title": HOSTILE}})
    text = text.replace("</head>", "<meta name=referrer><script>evil()</script></head>")
    made = page_anew(text)
    assert made == page(HOSTILE, {"panel": {"title": HOSTILE}})
    for damaged in ("", page("scene", {}), page("scene", {"panel": 1}), made.replace("panel", "{")):
        with pytest.raises(ValueError, match=r".+"):
            page_anew(damaged)


def test_the_page_is_unchanged_except_for_inserted_values():
    theirs, ours = asset("index.html").splitlines(), page("scene", {}).splitlines()
    assert [line.strip() for line in theirs if line not in ours] == [
        "<title>SuperSplat Viewer</title>",
        'content="width=device-width, initial-scale=1.0, maximum-scale=1.0, user-scalable=no, '
        'viewport-fit=cover"',
        '<base href="" />',
        '<script type="application/json" id="sse-bootstrap">',
        "null",
        "noanim: url.searchParams.has('noanim'),",
        "aa: url.searchParams.has('aa'),",
        "createViewer({ container: document.body, settings, ...options });",
    ]
    text = page("scene", {})
    assert panel_script() in text
    assert panel_style() in text


def test_the_policy_has_a_hash_of_each_script():
    text = page("scene", {"contentUrl": "./x"})
    policy = content_policy(text, "'self'")
    scripts = re.findall(r'<script type="module">(.*?)</script>', text, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_the_self_contained_page_has_the_licence():
    text = whole_page("scene", {}, "<p>body</p>")
    assert "<p>body</p>\n    </body>" in text
    assert asset("LICENSE") in text
    assert "sourceMappingURL=index" not in text
    (policy,) = re.findall(r'Content-Security-Policy" content="(.*?)"', text)
    assert "self" not in policy
    assert "http" not in policy
    # The policy comes before everything that it restricts.
    assert text.index("Content-Security-Policy") < text.index("<script")


def test_a_checkout_without_the_viewer(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_page, "_FOLDER", tmp_path)
    with pytest.raises(UserError, match="run make native"):
        page("scene", {})
