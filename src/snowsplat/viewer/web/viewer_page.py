"""The page for finished scenes: the SuperSplat viewer of PlayCanvas, bundled with the package.

The page is third-party (third_party/README.md names the version). Settings (viewer_settings.py),
the title and the initial view are inserted at the places that it provides, and the panel (panel.py)
at the place where the page creates the viewer. The studio serves it, so this needs no torch.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snowsplat.util.errors import UserError
from snowsplat.util.html import with_colours
from snowsplat.util.safe_json import parse_json

_FOLDER = Path(__file__).parents[2] / "_viewer"  # of the package
_PANEL = Path(__file__).parent
_SCRIPTS = ("texts.js", "hiding.js", "panel.js")
_STYLESHEET = '<link rel="stylesheet" href="./index.css" />'
_IMPORT = "import { createViewer } from './index.js';"
_CREATE = "createViewer({ container: document.body, settings, ...options });"
_NO_SCRIPTS = (
    '<noscript><p class="snow-failure">This page needs JavaScript.\n'
    "此网页需要 JavaScript。</p></noscript>"
)
# Where the viewer places the scene that it has loaded.
_PLACED = "entity.setLocalEulerAngles(0, 0, 180);"
# Event handlers in the HTML that the script creates: event.stopPropagation() of two buttons.
_HANDLER = re.compile(r' on[a-z]+=\\"([^"\\]*)\\"')
_BOOTSTRAP = '(<script type="application/json" id="sse-bootstrap">){}(</script>)'
_SLOT = re.compile(_BOOTSTRAP.format(r"\s*null\s*"))
_GIVEN = re.compile(_BOOTSTRAP.format("(.*?)"), re.DOTALL)
_INLINE_SCRIPT = re.compile(r'<script(?: type="module")?>(.*?)</script>', re.DOTALL)


def asset_file(name: str) -> Path:
    """The path of a file of the viewer; see `asset`."""
    return _FOLDER / name


def asset(name: str) -> str:
    """The content of a file of the viewer: index.html, index.css, index.js or LICENSE.

    Raises: UserError: the viewer has not been unpacked in this checkout.
    """
    try:
        return (_FOLDER / name).read_text(encoding="utf-8")
    except OSError:
        raise UserError(
            "{name}: the viewer's page is missing; in a checkout, run make native",
            name=_FOLDER / name,
        ) from None


def script(scale: float = 1.0) -> str:
    """index.js, which shows the files of the scene ``scale`` times as large as they say.

    Raises: UserError: see `asset`.
    """
    text = asset("index.js")
    if scale == 1:
        return text
    larger = f"entity.setLocalScale({scale}, {scale}, {scale});"
    return _replaced(text, _PLACED, f"{_PLACED} {larger}")


def panel_script() -> str:
    """The script of the panel, which also creates the viewer."""
    return "".join((_PANEL / name).read_text("utf-8") for name in _SCRIPTS)


def failure_script() -> str:
    """The script that says on the page why it shows no scene."""
    return (_PANEL / "failure.js").read_text("utf-8")


def panel_style() -> str:
    """The style sheet of the panel."""
    return with_colours((_PANEL / "panel.css").read_text(encoding="utf-8"))


def page(
    title: str, bootstrap: Mapping[str, Any], head: str = "", body: str = "", files: str = ""
) -> str:
    """The page; its stylesheet and script are the separate files index.css and index.js.

    ``bootstrap`` has the viewer's keys: settings, contentUrl, contentFilename, posterUrl;
    antialiased, that of the Gaussians; and panel, see `panel.panel_settings`. ``head`` and ``body``
    are HTML for these elements; ``files``: where the separate files are, "" or ending in "/".
    """
    text = asset("index.html")
    text = _replaced(
        text, "<title>SuperSplat Viewer</title>", f"<title>{html.escape(title)}</title>"
    )
    text = _replaced(text, ", maximum-scale=1.0, user-scalable=no", "")  # people may zoom texts
    # An empty icon; otherwise browsers would request one.
    icon = '<link rel="icon" href="data:," />'
    text = _replaced(text, '<base href="" />', f"{icon}\n        {head}" if head else icon)
    first = f"<style>\n{panel_style()}</style>\n        <script>\n{failure_script()}</script>"
    stylesheet = _STYLESHEET.replace("./", f"./{files}")
    text = _replaced(text, _STYLESHEET, f"{stylesheet}\n        {first}")
    text = _replaced(text, _IMPORT, _IMPORT.replace("./", f"./{files}"))
    text = _replaced(text, "    <body>", f"    <body>\n        {_NO_SCRIPTS}")
    if body:
        text = _replaced(text, "    </body>", f"{body}\n    </body>")
    text = _replaced(text, _CREATE, f"{{\n{panel_script()}}}")  # a block: its names are its own
    # The viewer does not read the mark of an antialiased scene file.
    text = _replaced(text, "aa: url.searchParams.has('aa')", "aa: bootstrap.antialiased")
    # No animation until the user presses Play.
    text = _replaced(text, "noanim: url.searchParams.has('noanim')", "noanim: true")
    parts = _SLOT.split(text)
    assert len(parts) == 4, "the viewer's page has no bootstrap"
    # "<" could end the script element or begin a comment in it.
    data = json.dumps(bootstrap).replace("<", "\\u003c")
    return parts[0] + parts[1] + data + parts[2] + parts[3]


def whole_page(title: str, bootstrap: Mapping[str, Any], body: str) -> str:
    """The page with its stylesheet and script embedded, and ``body`` (HTML) at its end.

    Its content security policy forbids all network requests.
    """
    css, script = asset("index.css"), asset("index.js")
    script = re.sub(r"\n//# sourceMappingURL=\S+\s*$", "\n", script)
    # The HTML parser would interpret these as markup. The files of the viewer do not contain them.
    assert "</style" not in css.lower()
    assert not re.search(r"</script|<!--|<script", script, re.IGNORECASE)
    text = page(title, bootstrap, body=body)
    text = _replaced(text, _STYLESHEET, f"<style>\n{css}</style>")
    text = _replaced(text, _IMPORT, script)
    policy = html.escape(content_policy(text, "blob: data:"))
    head = f"""<meta charset="UTF-8" />
        <meta http-equiv="Content-Security-Policy" content="{policy}" />
        <!-- The licence of the viewer, which must be part of every copy:
{asset("LICENSE")}-->"""
    return _replaced(text, '<meta charset="UTF-8" />', head)


def page_anew(text: str) -> str:
    """The page, of which only the bootstrap is that of ``text``, which a stranger may have written.

    Raises: ValueError: it has none.
    """
    given = _GIVEN.search(text)
    try:
        bootstrap = parse_json(given[2].encode()) if given else {}
        return page(str(bootstrap["panel"]["title"]), bootstrap)
    except (KeyError, TypeError) as error:
        raise ValueError(f"the page of a scene has no {error}") from None


def content_policy(page: str, sources: str) -> str:
    """The strictest Content-Security-Policy under which the page works.

    Inline scripts are allowed by their hashes. ``sources``: the sources from which the page may
    load.
    """
    scripts = [*_INLINE_SCRIPT.findall(page), *sorted(set(_HANDLER.findall(asset("index.js"))))]
    digests = [hashlib.sha256(script.encode()).digest() for script in scripts]
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {sources} {hashes} 'unsafe-hashes' 'wasm-unsafe-eval'",
            "worker-src blob:",  # sorts the Gaussians
            f"style-src {sources} 'unsafe-inline'",
            f"img-src {sources} blob: data:",
            f"connect-src {sources} blob: data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def _replaced(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, f"the viewer's page does not contain {old} exactly once"
    before, after = text.split(old)
    return before + new + after
