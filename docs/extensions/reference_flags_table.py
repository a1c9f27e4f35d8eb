"""The directive `reference-flags`: what becomes of each flag of the reference implementation.

```{reference-flags}
```
"""

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from snowsplat.cli.reference_flags import PROGRAMS, table


def markdown() -> str:
    """One table for each program."""
    lines: list[str] = []
    for subcommand, (program, _) in PROGRAMS.items():
        lines += [f"| `{program}` | `snowsplat {subcommand}` |", "|---|---|"]
        lines += [f"| {spellings} | {what} |" for spellings, what in table(subcommand)]
        lines.append("")
    return "\n".join(lines)


class ReferenceFlags(SphinxDirective):
    """The tables."""

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes(markdown())


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("reference-flags", ReferenceFlags)
    return {"parallel_read_safe": True}
