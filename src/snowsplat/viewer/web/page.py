"""The page that shows finished scenes: PlayCanvas' SuperSplat viewer, which the wheel carries.

The page is theirs (third_party/README.md says which version); what it shows and where it starts is
put into the places that it has for this. It turns a scene half round about the z axis, since its
own y axis points up; `settings` does the same to the start.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snowsplat.scene.initial_view import InitialView
from snowsplat.util.errors import UserError

_FOLDER = Path(__file__).parents[2] / "_viewer"
_STYLESHEET = '<link rel="stylesheet" href="./index.css" />'
_IMPORT = "import { createViewer } from './index.js';"
# In the HTML that their script makes: event.stopPropagation() of two buttons.
_HANDLER = re.compile(r' on[a-z]+=\\"([^"\\]*)\\"')
_INLINE_SCRIPT = re.compile(r'<script(?: type="module")?>(.*?)</script>', re.DOTALL)


def asset(name: str) -> str:
    """One of the viewer's files: index.html, index.css, index.js or LICENSE.

    Raises:
        UserError: a checkout in which it was not unpacked yet.
    """
    try:
        return (_FOLDER / name).read_text(encoding="utf-8")
    except OSError:
        raise UserError(
            f"{_FOLDER / name}: the viewer's page is absent; in a checkout, run make native"
        ) from None


def settings(start: InitialView, background: Sequence[float]) -> dict[str, Any]:
    """What the viewer takes as settings: where it starts, and a background colour in 0..1."""
    off = {"enabled": False}
    return {
        "version": 2,
        "tonemapping": "none",  # colours are shown as they were trained
        "highPrecisionRendering": False,
        "background": {"color": list(background)},
        "postEffectSettings": {
            "sharpness": {**off, "amount": 0},
            "bloom": {**off, "intensity": 0.1, "blurLevel": 2},
            "grading": {**off, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {**off, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {**off, "intensity": 0.5},
        },
        "animTracks": [],
        "cameras": [
            {
                "initial": {
                    "position": _turned(start.position),
                    "target": _turned(start.target),
                    "fov": start.fov,
                }
            }
        ],
        "annotations": [],
        "startMode": "default",
    }


def _turned(point: tuple[float, float, float]) -> list[float]:
    x, y, z = point
    return [-x, -y, z]


def page(title: str, bootstrap: Mapping[str, Any]) -> str:
    """The page, whose stylesheet and script lie beside it as index.css and index.js.

    ``bootstrap`` is the viewer's: settings, contentUrl, contentFilename.
    """
    text = asset("index.html")
    text = _replaced(
        text, "<title>SuperSplat Viewer</title>", f"<title>{html.escape(title)}</title>"
    )
    # An empty icon: else browsers ask for one.
    text = _replaced(text, '<base href="" />', '<link rel="icon" href="data:," />')
    # It stands still until someone moves it or presses Play.
    text = _replaced(text, "noanim: url.searchParams.has('noanim')", "noanim: true")
    seam = re.compile(r'(<script type="application/json" id="sse-bootstrap">)\s*null\s*(</script>)')
    parts = seam.split(text)
    assert len(parts) == 4, "the viewer's page has no bootstrap"
    return parts[0] + parts[1] + _json_in_script(bootstrap) + parts[2] + parts[3]


def whole_page(title: str, bootstrap: Mapping[str, Any], body: str) -> str:
    """The page with its stylesheet and script in it, and ``body`` (HTML) at its end.

    It asks the network for nothing: its content policy forbids it.
    """
    css, script = asset("index.css"), asset("index.js")
    script = re.sub(r"\n//# sourceMappingURL=\S+\s*$", "\n", script)
    # What the HTML parser would take for markup: their bundle has none of it.
    assert "</style" not in css.lower()
    assert not re.search(r"</script|<!--|<script", script, re.IGNORECASE)
    text = page(title, bootstrap)
    text = _replaced(text, _STYLESHEET, f"<style>\n{css}</style>")
    text = _replaced(text, _IMPORT, script)
    text = _replaced(text, "    </body>", f"{body}\n    </body>")
    policy = html.escape(content_policy(text, "blob: data:"))
    head = f"""<meta charset="UTF-8" />
        <meta http-equiv="Content-Security-Policy" content="{policy}" />
        <!-- The viewer, whose licence asks to be in every copy:
{asset("LICENSE")}-->"""
    return _replaced(text, '<meta charset="UTF-8" />', head)


def content_policy(page: str, sources: str) -> str:
    """A Content-Security-Policy under which the page works, and does nothing else.

    Its own scripts are named by their hashes. ``sources`` is where it may fetch from.
    """
    scripts = [*_INLINE_SCRIPT.findall(page), *sorted(set(_HANDLER.findall(asset("index.js"))))]
    digests = [hashlib.sha256(script.encode()).digest() for script in scripts]
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {sources} {hashes} 'unsafe-hashes' 'wasm-unsafe-eval'",
            "worker-src blob:",  # the sorter of the Gaussians
            f"style-src {sources} 'unsafe-inline'",
            f"img-src {sources} blob: data:",
            f"connect-src {sources} blob: data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def _replaced(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, f"the viewer's page has not one {old}"
    before, after = text.split(old)
    return before + new + after


def _json_in_script(value: Any) -> str:
    # "<" could end the script's element, or begin a comment in it.
    return json.dumps(value).replace("<", "\\u003c")
