"""The directive `drawing`: a figure of one or more SVG files, in the colours of the page.

```{drawing} ellipse axes
The caption, with formulas such as $x$.
```

The arguments are names of files in `docs/learn/figures/`, without ".svg". The files become elements
of the page. So the style sheet of the site can change their colours with the theme, and a formula
of the caption is typeset. The panels are side by side if there is enough space, otherwise below
each other.
"""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Drawing(SphinxDirective):
    """A figure: the SVG elements as panels, and the content of the directive as the caption."""

    required_arguments = 1
    final_argument_whitespace = True
    has_content = True

    def run(self) -> list[nodes.Node]:
        panels = []
        for name in self.arguments[0].split():
            _, path = self.env.relfn2path(f"/learn/figures/{name}.svg")
            if not Path(path).exists():
                raise self.error(f"{path} is missing; see docs/learn/figures/README.md")
            self.env.note_dependency(path)
            panels.append(Path(path).read_text(encoding="utf-8"))
        html = '<div class="panels">' + "".join(panels) + "</div>"
        figure = nodes.figure("", nodes.raw("", html, format="html"), classes=["drawing"])
        content = self.parse_content_to_nodes()
        assert len(content) == 1, "the caption of a drawing is one paragraph"
        caption = nodes.caption("", "", *content[0].children)
        figure += caption
        return [figure]


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("drawing", Drawing)
    return {"parallel_read_safe": True}
