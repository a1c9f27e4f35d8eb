"""The colours of the pages: each stands in one file."""

import re
from collections import defaultdict
from pathlib import Path

import snowsplat
from snowsplat.util.theme import THEME, colours, with_colours

_SOURCE = Path(snowsplat.__file__).parent
_SUFFIXES = {".css", ".html", ".j2", ".js", ".py"}


def test_colours_by_name():
    assert {"amber", "night"} <= set(colours())
    assert "accent" not in colours()  # it depends on light and dark
    css = "a { color: var(--amber); fill: var(--accent); }"
    assert with_colours(css) == f"a {{ color: {colours()['amber']}; fill: var(--accent); }}"


def test_a_colour_of_the_theme_stands_once():
    places = defaultdict(list)
    for file in _SOURCE.rglob("*"):
        if file.suffix in _SUFFIXES and "_viewer" not in file.parts:
            for colour in re.findall(r"#[0-9a-f]{6}\b", file.read_text("utf-8"), re.IGNORECASE):
                places[colour.lower()].append(file.name)
    named = re.findall(r"#[0-9a-f]{6}\b", THEME.read_text("utf-8"))
    assert {"#ffb454", "#a35808"} <= set(named)
    assert {colour: places[colour] for colour in named} == {
        colour: [THEME.name] for colour in named
    }
