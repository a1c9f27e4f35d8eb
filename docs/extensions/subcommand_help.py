"""The directive `subcommands`: describes all subcommands, from the output of their `--help`.

```{subcommands}
```
"""

import contextlib
import io
import os
import re
import textwrap
from typing import Any
from unittest import mock

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from snowsplat import extras
from snowsplat.cli import main

extras.register()
# In a terminal of this width, no line is wrapped.
_WIDTH = 4000
_ENTRY = re.compile(r"│ (?P<name>\S.*?)(?:  +(?P<text>.*?))? *│$")
_TEXT = re.compile(r"│  +(?P<text>\S.*?) *│$")


def help_text(name: str) -> str:
    """What `snowsplat NAME --help` prints."""
    # tyro draws its boxes with the characters of the encoding of the output.
    output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    wide = mock.patch.dict(os.environ, COLUMNS=str(_WIDTH))
    with wide, contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        main.parse([name, "--help"])
    return output.buffer.getvalue().decode()


def flags(text: str) -> list[tuple[str, str]]:
    """The arguments and flags in a help text, as they are written there, and their descriptions."""
    found: list[tuple[str, str]] = []
    for line in text.splitlines():
        if match := _TEXT.match(line):
            name, description = found.pop()
            found.append((name, f"{description} {match['text']}".strip()))
        elif match := _ENTRY.match(line):
            found.append((match["name"], match["text"] or ""))
    assert all(description for _, description in found), "the layout of help texts has changed"
    return found


def _escaped(text: str) -> str:
    """Plain text as Markdown."""
    return re.sub(r"([\\`*_{}\[\]<>#|~$^])", r"\\\1", text)


def markdown(name: str) -> str:
    """The help text of a subcommand as Markdown."""
    text = help_text(name)
    usage, _, rest = text.partition("\n\n")
    description = rest.partition("╭")[0].rstrip()
    summary, _, details = description.partition("\n\n")
    lines = [_escaped(summary), "", "```text", usage.removeprefix("usage: "), "```", ""]
    for block in re.split(r"\n\n(?=\S)", details):
        title, _, body = block.partition("\n")
        indented = all(line.startswith("  ") for line in body.splitlines() if line)
        if title == "Notes:":
            lines += [_escaped(textwrap.dedent(body)), ""]
        elif title.endswith(":") and body and indented:
            title = "" if title == "Examples:" else _escaped(title)
            lines += [title, "", "```text", textwrap.dedent(body), "```", ""]
        elif block:
            lines += [_escaped(block), ""]
    lines += ["```{program} snowsplat " + name, "```", ""]
    for flag, meaning in flags(text):
        if flag != "-h, --help":
            lines += ["```{option} " + flag, _escaped(meaning), "```", ""]
    return "\n".join(lines)


class Subcommands(SphinxDirective):
    """One section for each subcommand."""

    def run(self) -> list[nodes.Node]:
        sections = (f"## {name}\n\n{markdown(name)}" for name in main.SUBCOMMANDS)
        return self.parse_text_to_nodes("\n".join(sections), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("subcommands", Subcommands)
    return {"parallel_read_safe": True}
