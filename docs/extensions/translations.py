"""Checks that the Chinese pages are complete and not older than the English ones.

`docs/zh/` has a page for each page of `TRANSLATED`, and for each lesson in `notebooks/` a page with
the text between the code cells; README.md has README.zh-CN.md beside it. The first line of a
Chinese page contains a digest of the English text that it translates:

    <!-- translation of quick-start.md 0123456789abcdef -->

If a page is missing, or the English text has changed, there is a warning (an error in `make docs`)
that says what to do. The digest ignores line breaks, so wrapping a paragraph again changes nothing.
The extension also sets the language of the Chinese pages, which Sphinx knows only for a whole site,
and links each page to the same page in the other language.
"""

import hashlib
import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util import logging

_DOCS = Path(__file__).resolve().parents[1]
#: Pages of `docs/` that are translated, as patterns.
TRANSLATED = (
    "installation.md",
    "questions.md",
    "quick-start.md",
    "guides/anamorph.md",
    "guides/globe.md",
    "guides/gpu.md",
    "guides/images-and-videos.md",
    "guides/memory.md",
    "guides/mesh.md",
    "guides/photos.md",
    "guides/scale.md",
    "guides/scene-files.md",
    "guides/studio.md",
    "guides/training.md",
    "guides/troubleshooting.md",
    "guides/viewers.md",
    "learn/*.md",
)
#: Pages of `docs/zh/` that are not translations.
OWN = ("index.md", "glossary.md", "notebooks/exercises.md")
_FIRST_LINE = re.compile(r"<!-- translation of (\S+) ([0-9a-f]{16}) -->\n")

# Excerpts of source files (docs/excerpts.py): a translation has the same, and nothing to translate.
_EXCERPT = re.compile(r"(<!-- code: .* -->)\n```.*\n(?:.*\n)*?```")

# A formula in its own lines, as Jupyter reads it. GitHub needs a block, as the other pages have.
_FORMULA = re.compile(r"^\$\$ (.*) \$\$$", re.MULTILINE)

logger = logging.getLogger(__name__)


def text_of(file: Path) -> str:
    """The Markdown text of a page or of a notebook.

    In a notebook, the number that Jupyter shows beside a code cell takes the place of its code.
    """
    text = file.read_text(encoding="utf-8")
    if file.suffix != ".ipynb":
        return text
    number = itertools.count(1)
    parts = [
        "".join(cell["source"]) if cell["cell_type"] == "markdown" else f"`[{next(number)}]`"
        for cell in json.loads(text)["cells"]
    ]
    return _FORMULA.sub(r"```math\n\1\n```", "\n\n".join(parts)) + "\n"


def digest(text: str) -> str:
    """16 hexadecimal digits that change with the text, but not with its line breaks or excerpts."""
    text = _EXCERPT.sub(r"\1", text)
    return hashlib.sha256(" ".join(text.split()).encode()).hexdigest()[:16]


def pairs(docs: Path) -> Iterator[tuple[Path, Path]]:
    """The English pages and notebooks that are translated, each with its Chinese page."""
    yield docs.parent / "README.md", docs.parent / "README.zh-CN.md"
    notebooks = docs.parent / "notebooks"
    yield notebooks / "README.md", docs / "zh" / "guides" / "notebooks.md"
    for notebook in sorted(notebooks.glob("*.ipynb")):
        yield notebook, docs / "zh" / "notebooks" / f"{notebook.stem}.md"
    for pattern in TRANSLATED:
        for page in sorted(docs.glob(pattern)):
            yield page, docs / "zh" / page.relative_to(docs)


def problems(docs: Path) -> Iterator[str]:
    """One line for each Chinese page that is missing, too old, or has no English page."""
    known = {docs / "zh" / name for name in OWN}
    for english, chinese in pairs(docs):
        known.add(chinese)
        source = english.relative_to(docs.parent)
        name = chinese.relative_to(docs.parent)
        current = digest(text_of(english))
        line = f"<!-- translation of {english.name} {current} -->"
        if not chinese.exists():
            yield f"{name}: missing; translate {source}, and begin with the line {line}"
            continue
        match = _FIRST_LINE.match(chinese.read_text(encoding="utf-8"))
        if match is None:
            yield f"{name}: does not name the text that it translates; begin with the line {line}"
        elif match[1] != english.name:
            yield f"{name}: is a translation of {match[1]}; begin with the line {line}"
        elif match[2] != current:
            yield f"{name}: older than {source}; update it, then change its first line to {line}"
    for chinese in sorted((docs / "zh").rglob("*.md")):
        if chinese not in known:
            name = chinese.relative_to(docs.parent)
            yield f"{name}: there is no English page of this name; remove it or rename it"


def _check(app: Sphinx) -> None:
    for problem in problems(_DOCS):
        logger.warning("%s", problem, type="translation")


def _language(app: Sphinx, page: str, template: str, context: dict[str, Any], _: Any) -> None:
    chinese = page.startswith("zh/")
    if chinese:
        context["language"] = "zh-CN"
    other = page.removeprefix("zh/") if chinese else f"zh/{page}"
    if other in app.env.all_docs:
        language, name = ("en", "English") if chinese else ("zh-CN", "中文")
        address = app.builder.get_relative_uri(page, other)
        link = f'<a href="{address}" lang="{language}" hreflang="{language}">{name}</a>'
        context["body"] = f'<p class="language">{link}</p>{context["body"]}'


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("builder-inited", _check)
    app.connect("html-page-context", _language)
    return {"parallel_read_safe": True}
