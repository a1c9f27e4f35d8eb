"""Renews the excerpts of source files in the pages of the documentation.

    python docs/excerpts.py

An excerpt is a fenced block, so that every Markdown renderer shows it. The comment before it says
what the block contains: an object of a Python file, or lines, or lines within an object.

    <!-- code: src/snowsplat/ops/reference.py sh_basis -->
    <!-- code: src/snowsplat/ops/reference.py from "x, y, z =" to "means2d =" -->
    <!-- code: src/snowsplat/ops/reference.py rasterize from "order, abs_grad" -->

Each string is a part of a line, and names the first line that contains it. With `before` instead
of `to`, the last line is left out. `tests/test_docs_pages.py` checks that all blocks are current.
"""

import ast
import re
from pathlib import Path
from textwrap import dedent

ROOT = Path(__file__).resolve().parents[1]
LANGUAGES = {".py": "python", ".h": "cpp", ".cpp": "cpp", ".js": "javascript"}
_BLOCK = re.compile(
    r"<!-- code: (?P<file>\S+)(?: (?!from |to |before )(?P<name>[\w.]+))?"
    r'(?: from "(?P<start>[^"]+)")?(?: (?P<until>to|before) "(?P<end>[^"]+)")? -->'
    r"(?:\n```.*\n(?:.*\n)*?```)?"
)


def _object(text: str, name: str) -> str:
    """The lines of a function, class or method of a Python file."""
    nodes: list[ast.stmt] = ast.parse(text).body
    for part in name.split("."):
        kinds = (ast.FunctionDef, ast.ClassDef)
        found = [node for node in nodes if isinstance(node, kinds) and node.name == part]
        if not found:
            raise ValueError(f"there is no {name}")
        nodes = found[0].body
    first = min([found[0].lineno, *(d.lineno for d in found[0].decorator_list)])
    return "".join(text.splitlines(keepends=True)[first - 1 : found[0].end_lineno])


def _line(lines: list[str], part: str, first: int) -> int:
    for i, line in enumerate(lines[first:], first):
        if part in line:
            return i
    raise ValueError(f'no line contains "{part}"')


def excerpt(match: re.Match[str]) -> str:
    """The comment and its block; ValueError if the source has no such object or line."""
    path = ROOT / match["file"]
    text = path.read_text(encoding="utf-8")
    lines = (_object(text, match["name"]) if match["name"] else text).splitlines()
    first = _line(lines, match["start"], 0) if match["start"] else 0
    last = len(lines)
    if match["end"]:
        last = _line(lines, match["end"], first) + (match["until"] == "to")
    code = dedent("\n".join(lines[first:last])).strip("\n")
    comment = match[0].partition("\n")[0]
    return f"{comment}\n```{LANGUAGES[path.suffix]}\n{code}\n```"


def renewed(page: Path) -> str:
    """The text of a page with current excerpts; ValueError names a comment that has none."""

    def replace(match: re.Match[str]) -> str:
        try:
            return excerpt(match)
        except (OSError, ValueError) as error:
            comment = match[0].partition("\n")[0]
            raise ValueError(f"{page.relative_to(ROOT)}: {comment}: {error}") from None

    return _BLOCK.sub(replace, page.read_text(encoding="utf-8"))


def pages() -> list[Path]:
    """The pages with excerpts."""
    files = sorted((ROOT / "docs").rglob("*.md"))
    return [file for file in files if "<!-- code: " in file.read_text(encoding="utf-8")]


if __name__ == "__main__":
    for file in pages():
        text = renewed(file)
        if text != file.read_text(encoding="utf-8"):
            file.write_text(text, encoding="utf-8")
            print(file.relative_to(ROOT))
