"""The looks of the site for pages that any Markdown renderer shows.

- A paragraph of SVG images from `docs/learn/figures`, followed by a block quote, becomes a figure:
  the images are its panels, and the quote is its caption. The files become elements of the page, so
  that the style sheet of the site changes their colours with the theme. The alternative text of an
  image becomes the title of its panel.
- A comment `<!-- toctree` or `<!-- toctree: CAPTION`, with names of pages, becomes a part of the
  table of contents.
- Code such as `snowsplat.Camera` becomes a link to its description.
"""

import re
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

FIGURES = Path(__file__).resolve().parents[1] / "learn" / "figures"
_TOCTREE = re.compile(r"<!-- toctree(?:: (.+))?\n((?:.+\n)+?)-->")
_NAME = re.compile(r"snowsplat(?:\.\w+)+")


class Figures(SphinxTransform):
    """Images and the block quote after them become a figure."""

    default_priority = 200  # before Sphinx collects the images

    def apply(self, **kwargs: Any) -> None:
        for paragraph in list(self.document.findall(nodes.paragraph)):
            parts = [part for part in paragraph.children if str(part).strip()]
            images = [part for part in parts if isinstance(part, nodes.image)]
            files = [self._file(image) for image in images]
            if not images or len(images) < len(parts) or None in files:
                continue
            panels = []
            for image, file in zip(images, files, strict=True):
                self.env.note_dependency(str(file))
                panels.append(_element(file.read_text(encoding="utf-8"), image["alt"]))
            html = '<div class="panels">' + "".join(panels) + "</div>"
            figure = nodes.figure("", nodes.raw("", html, format="html"), classes=["drawing"])
            quote = paragraph.next_node(descend=False, siblings=True)
            if isinstance(quote, nodes.block_quote):
                assert len(quote) == 1, f"the caption is one paragraph: {quote.astext()}"
                figure += nodes.caption("", "", *quote[0].children)
                quote.parent.remove(quote)
            paragraph.replace_self(figure)

    def _file(self, image: nodes.image) -> Path | None:
        folder = Path(self.env.doc2path(self.env.docname)).parent
        file = (folder / image["uri"]).resolve()
        return file if file.parent == FIGURES and file.suffix == ".svg" else None


def _element(svg: str, title: str) -> str:
    """The SVG element without its own style, which would apply to the whole page."""
    svg = re.sub(r"<style>.*?</style>", "", svg, flags=re.DOTALL)
    return re.sub(r"<title>.*?</title>", lambda _: f"<title>{escape(title)}</title>", svg)


class Names(SphinxTransform):
    """Code that is the full name of an object becomes a reference to it."""

    default_priority = 200

    def apply(self, **kwargs: Any) -> None:
        for code in list(self.document.findall(nodes.literal)):
            name = code.astext()
            if not _NAME.fullmatch(name) or isinstance(
                code.parent, (pending_xref, nodes.reference)
            ):
                continue
            reference = pending_xref("", refdomain="py", reftype="obj", reftarget=name)
            reference["refdoc"] = self.env.docname
            code.replace_self(reference)
            reference += code


def _toctree(app: Sphinx, name: str, content: list[str]) -> None:
    def fence(match: re.Match[str]) -> str:
        caption = f":caption: {match[1]}\n" if match[1] else ""
        return f"```{{toctree}}\n:hidden:\n{caption}\n{match[2]}```"

    content[0] = _TOCTREE.sub(fence, content[0])


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_transform(Figures)
    app.add_transform(Names)
    app.connect("source-read", _toctree)
    return {"parallel_read_safe": True}
