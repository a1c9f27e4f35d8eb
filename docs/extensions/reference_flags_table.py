"""The directive `reference-flags`: what becomes of each flag of the reference implementation.

```{reference-flags}
```
"""

from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from snowsplat.cli.reference_flags import programs


def markdown() -> str:
    """One table for each program."""
    lines: list[str] = []
    for subcommand, (program, _) in programs().items():
        lines += [f"| `{program}` | `snowsplat {subcommand}` |", "|---|---|"]
        lines += [f"| {spellings} | {what} |" for spellings, what in table(subcommand)]
        lines.append("")
    return "\n".join(lines)


def table(subcommand: str) -> Iterator[tuple[str, str]]:
    """The spellings of each flag of a program, and what becomes of it, as Markdown."""
    for flag in programs()[subcommand][1]:
        note = flag.note.replace("|", "\\|")
        what = {
            "own": "the same",
            "becomes": f"`{' '.join(flag.new)}`" if flag.new else "the same",
            "ignored": "no effect",
            "refused": "refused",
        }[flag.outcome]
        if flag.only_with:
            what += f" with `{flag.only_with}`; otherwise no effect"
        separator = ": " if flag.only_with or flag.outcome in ("ignored", "refused") else "; "
        yield " ".join(f"`{s}`" for s in flag.spellings), what + separator * bool(note) + note


class ReferenceFlags(SphinxDirective):
    """The tables."""

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes(markdown())


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("reference-flags", ReferenceFlags)
    return {"parallel_read_safe": True}
