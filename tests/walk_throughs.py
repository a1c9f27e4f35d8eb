"""The walk-throughs of docs/extend as data: files that they create and change, and commands.

A walk-through is a page whose title begins with "Add". Its code blocks are commands (`sh`), the
content of a new file (after "Create `path`:"), or changes of a file (`diff`, after "Change
`path`:"). A diff is applied by its text, without line numbers: the lines that it keeps and removes
must occur exactly once.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "extend"
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"(Create|Change)\s+`([^`]+)`:\s*$")


class Mismatch(Exception):
    """A block cannot be applied to the files, because their content is different."""


@dataclass
class WalkThrough:
    """One page: new files and changes in their order, then the commands in theirs.

    Attributes:
        edits: (path, kind, text); the kind is "diff" or the language of a new file.
        commands: lines of shell.
    """

    title: str
    edits: list[tuple[str, str, str]] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)

    def apply(self, root: Path) -> None:
        """Make the changes in a copy of the project.

        Raises:
            Mismatch: a new file exists already, or the lines of a diff do not occur exactly once.
        """
        for name, kind, text in self.edits:
            path = root / name
            if kind == "diff":
                path.write_text(patched(name, path.read_text(encoding="utf-8"), text), "utf-8")
            elif path.exists():
                raise Mismatch(f"{name} exists already")
            else:
                path.write_text(text, encoding="utf-8")


def walk_throughs() -> list[WalkThrough]:
    """The walk-throughs of docs/extend, in the order of their file names.

    Raises:
        Mismatch: no file is named before a block, or a new file is a diff.
    """
    pages = (page.read_text(encoding="utf-8") for page in sorted(FOLDER.glob("*.md")))
    return [walk_through(page) for page in pages if page.startswith("# Add ")]


def walk_through(page: str) -> WalkThrough:
    """The walk-through of a page, or a `Mismatch` as in `walk_throughs`."""
    walk = WalkThrough(page.partition("\n")[0].removeprefix("# "))
    for block in _BLOCK.finditer(page):
        kind, text = block.groups()
        if kind == "sh":
            walk.commands += text.splitlines()
            continue
        named = _FILE.search(page[: block.start()])
        if named is None or (named[1] == "Change") != (kind == "diff"):
            raise Mismatch(f"{walk.title}: no file is named before a block in {kind}:\n{text}")
        walk.edits.append((named[2], kind, text))
    return walk


def patched(name: str, content: str, diff: str) -> str:
    """``content`` after a diff, whose hunks are separated by lines "@@".

    Raises:
        Mismatch: the lines that a hunk keeps and removes do not occur exactly once.
    """
    for hunk in re.split(r"^@@\n", diff, flags=re.MULTILINE):
        lines = [line or " " for line in hunk.splitlines()]
        before = "".join(f"{line[1:]}\n" for line in lines if line[0] in " -")
        after = "".join(f"{line[1:]}\n" for line in lines if line[0] in " +")
        starts = [m.start() for m in re.finditer("^" + re.escape(before), content, re.MULTILINE)]
        if len(starts) != 1:
            raise Mismatch(f"{name}: these lines occur {len(starts)} times, not once:\n{before}")
        content = content[: starts[0]] + after + content[starts[0] + len(before) :]
    return content
