"""Links to Markdown files of the repository lead to pages of the site.

In the repository, the pages of `docs/` and the files in `_PAGES` link to each other by relative
paths. On the site, a page in `docs/project` includes each of the files in `_PAGES`. This extension
adapts the paths of the links. Sphinx reports links to files that do not exist.
"""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

_DOCS = Path(__file__).resolve().parents[1]
_ROOT = _DOCS.parent
_PAGES = {
    _ROOT / "CHANGELOG.md": _DOCS / "project" / "changelog.md",
    _ROOT / "CONTRIBUTING.md": _DOCS / "project" / "contributing.md",
    _ROOT / "README.md": _DOCS / "index.md",
    _ROOT / "benchmarks" / "README.md": _DOCS / "project" / "benchmarks.md",
    _ROOT / "notebooks" / "README.md": _DOCS / "guides" / "notebooks.md",
    _ROOT / "third_party" / "README.md": _DOCS / "project" / "third-party.md",
}
_LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")


def _for_page(text: str, folder: Path, page_folder: Path) -> str:
    """``text`` of a file in ``folder``, with its links relative to ``page_folder``."""

    def link(match: re.Match[str]) -> str:
        file = (folder / match[1]).resolve()
        target = os.path.relpath(_PAGES.get(file, file), page_folder)
        return f"]({Path(target).as_posix()}{match[2] or ''})"

    return _LINK.sub(link, text)


def _page(app: Sphinx, name: str, content: list[str]) -> None:
    folder = (_DOCS / name).parent
    content[0] = _for_page(content[0], folder, folder)


def _included(app: Sphinx, path: Path, parent: str, content: list[str]) -> None:
    file = (_DOCS / path).resolve()
    content[0] = _for_page(content[0], file.parent, _PAGES[file].parent)


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("source-read", _page)
    app.connect("include-read", _included)
    return {"parallel_read_safe": True}
