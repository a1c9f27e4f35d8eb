"""Adapts docstrings, which are plain text with sections in Google style, to Sphinx.

- In the docstrings of snowsplat, an indented block after a paragraph is an example or a table. In
  reStructuredText, it would be a quotation, so a directive is inserted. The blocks of sections
  ("Args:") and lists are not changed.
- Bars and asterisks have no special meaning.
- The first line of the docstring of a property is not "type: description".
- "a, b: text" describes two parameters or attributes; ":param a, b:" would be b of type a.
- In a signature, the default of a field that a factory makes is "...", because "<factory>" is not
  valid Python.
- The label of the attributes of a class is "Attributes", and dashes are not two hyphens.
"""

import ast
import re
import textwrap
from itertools import takewhile
from typing import Any

from docutils import nodes
from sphinx.addnodes import literal_strong
from sphinx.application import Sphinx

_SECTION = re.compile(r"(Args|Attributes|Examples?|Notes?|Raises|Returns|Yields):$")
_LIST_ITEM = re.compile(r"(-|\d+\.) |\.\. ")
_CODE = re.compile(r"(`+[^`]*`+)")
_MARKUP = re.compile(r"[|*]")
_FIELD = re.compile(r":(param|ivar|keyword) ([^:]+):")


def _plain(line: str) -> str:
    """A line of text, with bars and asterisks escaped, except in code."""
    parts = _CODE.split(line)
    return "".join(p if p.startswith("`") else _MARKUP.sub(r"\\\g<0>", p) for p in parts)


def _language(lines: list[str]) -> str:
    """python or text: the language of the indented block at the beginning of ``lines``."""
    block = takewhile(lambda line: not line or line.startswith(" "), lines)
    try:
        ast.parse(textwrap.dedent("\n".join(block)))
    except SyntaxError:
        return "text"
    return "python"


def as_rest(lines: list[str]) -> list[str]:
    """A docstring with its examples marked and other characters escaped."""
    found: list[str] = []
    start = ""  # the last line that is not indented
    in_code = False
    for i, line in enumerate(lines):
        indented = line.startswith(" ")
        if line and not indented:
            start, in_code = line, False
        elif indented and not in_code and i and not lines[i - 1]:
            in_code = not (_SECTION.match(start) or _LIST_ITEM.match(start))
            if in_code and not start.endswith("::"):
                found += [f".. code-block:: {_language(lines[i:])}", ""]
        found.append(line if in_code and indented else _plain(line))
    return found


def _before_napoleon(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    comment = ["..", ""] if what in ("attribute", "data", "property") else []
    lines[:] = comment + as_rest(lines)


def _after_napoleon(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    lines[:] = [_FIELD.sub(lambda match: match[0].replace(", ", ","), line) for line in lines]


def _signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, result: str
) -> tuple[str | None, str]:
    return (signature or "").replace("<factory>", "...") or None, result


def _fields(app: Sphinx, doctree: nodes.document) -> None:
    for field in doctree.findall(nodes.field):
        for text in list(field.findall(nodes.Text)):
            strong = isinstance(text.parent, literal_strong)
            if strong and "," in text:
                text.parent.replace(text, nodes.Text(text.replace(",", ", ")))
            elif text in _TEXTS and not strong:
                text.parent.replace(text, nodes.Text(_TEXTS[text]))


_TEXTS = {" -- ": " – ", "Variables": "Attributes"}


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("autodoc-process-docstring", _before_napoleon, priority=400)
    app.connect("autodoc-process-docstring", _after_napoleon, priority=600)
    app.connect("autodoc-process-signature", _signature)
    app.connect("doctree-read", _fields)
    return {"parallel_read_safe": True}
