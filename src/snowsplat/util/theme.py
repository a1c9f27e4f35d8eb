"""The colours of all pages: `theme.css` defines them as CSS variables."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

#: The style sheet, which pages include.
THEME = Path(__file__).with_name("theme.css")


@cache
def colours() -> dict[str, str]:
    """The colours that are the same in light and dark, by name."""
    return dict(re.findall(r"--(\w+): (#[0-9a-f]+);", THEME.read_text(encoding="utf-8")))


def with_colours(css: str) -> str:
    """A style sheet in which ``var(--name)`` of `colours` is replaced by the colour, for pages
    without `THEME`."""
    return re.sub(r"var\(--(\w+)\)", lambda found: colours().get(found[1], found[0]), css)
