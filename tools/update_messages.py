"""Brings src/snowsplat/locale/zh/*.po up to date with the messages of the program: `make messages`.

There is one file for each package. New messages have an empty text, which a translator fills in;
texts of messages that no longer exist are removed. A message that moves keeps its text.
"""

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_dir
from babel.messages.pofile import read_po, write_po

SOURCE = Path(__file__).resolve().parents[1] / "src" / "snowsplat"
LANGUAGE = "zh"
# The calls whose first text is a message. For others: the positions of the texts.
_CALLS = ("message", "print_message", "inform", "needed", "warning", "info", "UserError", "Problem")
_KEYWORDS = dict.fromkeys(_CALLS) | {"plural": (1, 2), "SettingError": (2,)}

Key = str | tuple[str, str]


def messages_of(source: Path = SOURCE) -> Iterator[tuple[str, Key]]:
    """The package and the key of each message; two texts: one and many."""
    found = extract_from_dir(
        source,
        [("**.py", "python"), ("**.html.j2", "jinja2.ext:babel_extract")],
        keywords=keywords(source) | {"t": None},
        comment_tags=(),
    )
    for file, _, key, _, _ in found:
        # A single word may also be an item of a dictionary that is called `message`.
        is_word = isinstance(key, str) and not any(mark in key for mark in " {%")
        if not is_word or file.endswith(".j2") or key in _words(source / file):
            parts = Path(file).parts
            yield parts[0] if len(parts) > 1 else "snowsplat", key
    yield from _allowed(source)


def keywords(source: Path) -> dict[str, tuple[int, ...] | None]:
    """The calls with texts: an error takes its text as the class from which it is derived."""
    bases = {
        node.name: [getattr(base, "id", "") for base in node.bases]
        for file in source.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    }
    found: dict[str, tuple[int, ...] | None] = dict(_KEYWORDS)
    while new := {
        name: found[base]
        for name, each in bases.items()
        for base in each
        if base in found and name not in found
    }:
        found |= new
    return found


@cache
def _words(file: Path) -> set[str]:
    """The first arguments of all calls of `message` in a module."""
    calls = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    return {
        call.args[0].value
        for call in calls
        if isinstance(call, ast.Call)
        and getattr(call.func, "id", "") == "message"
        and isinstance(call.args[0], ast.Constant)
    }


def _allowed(source: Path) -> Iterator[tuple[str, Key]]:
    """What settings allow, in words: the argument ``allowed`` of their declarations."""
    for file in sorted(source.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            for each in node.keywords if isinstance(node, ast.Call) else ():
                value = getattr(each.value, "value", None)
                if each.arg == "allowed" and isinstance(value, str):
                    yield file.relative_to(source).parts[0], value


def translations(folder: Path) -> Catalog:
    """The catalogue of all files of a language."""
    catalogue = Catalog(locale=folder.name)
    for file in sorted(folder.glob("*.po")):
        with file.open("rb") as opened:
            for message in read_po(opened, locale=folder.name):
                if message.id and message.string:
                    catalogue[message.id] = message
    return catalogue


def main() -> int:
    folder = SOURCE / "locale" / LANGUAGE
    known = translations(folder)
    packages: dict[str, Catalog] = {}
    seen: set[Key] = set()
    empty = 0
    for package, key in messages_of():
        if key in seen:
            continue
        seen.add(key)
        catalogue = packages.setdefault(package, Catalog(locale=LANGUAGE, fuzzy=False))
        before = known.get(key if isinstance(key, str) else key[0])
        string = before.string if before is not None else ""
        if isinstance(key, tuple) and isinstance(string, str):
            string = (string,)
        if isinstance(key, str) and not isinstance(string, str):
            string = string[0]
        empty += not any(string if isinstance(string, tuple) else (string,))
        catalogue.add(key, string)
    for file in folder.glob("*.po"):
        if file.stem not in packages:
            file.unlink()
    for package, catalogue in sorted(packages.items()):
        with (folder / f"{package}.po").open("wb") as target:
            target.write(f"# The messages of snowsplat/{package} in Chinese.\n\n".encode())
            write_po(target, catalogue, width=100, sort_output=True, omit_header=True)
    print(f"{len(seen)} messages, {empty} without a translation")
    return 0


if __name__ == "__main__":
    sys.exit(main())
