"""Report pages: jinja2 templates, one self-contained HTML file each, in English and Chinese.

A template is a file ``*.html.j2`` beside the module that renders it. It extends
`util/report/report.html.j2`, which has the style in light and dark, and the button for the
language. The pages are also well-formed XML. Messages are shown in all languages; ``t`` is
`in_languages`. All other values are escaped.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape
from PIL import Image

from snowsplat.util.duration import duration
from snowsplat.util.messages import LANGUAGES, Message, as_message, message, plural
from snowsplat.util.safe_json import printable

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


if TYPE_CHECKING:
    import jinja2

_PACKAGE = Path(__file__).parents[1]
_STOPS = {"en": ".", "zh": "。"}


def render_page(template: str, **values: Any) -> str:
    """A page. ``template``: the path of its file in the package. ``values``: those that it uses."""
    return _environment().get_template(template).render(values)


def in_languages(text: object, /, **values: Any) -> Markup:
    """A text in each language, of which the style of the page shows one.

    ``text``: the key of a message with these ``values``; or a message, its JSON, an error, or
    another text.
    """
    return _elements(message(text, **values) if isinstance(text, str) else as_message(text))


def sentence(text: object, stop: bool = False) -> Markup:
    """A clause in each language with a capital letter, and with a full ``stop``."""
    return _elements(
        as_message(text),
        lambda words, language: words[:1].upper() + words[1:] + _STOPS[language] * stop,
    )


def svg_text(text: object, tag: str = "tspan") -> Markup:
    """A text in each language for a ``<text>`` of SVG, or as its elements ``tag``."""
    return _elements(as_message(text), tag=tag)


def _elements(
    text: Message,
    change: Callable[[str, str], str] = lambda words, _: words,
    tag: str = "span",
) -> Markup:
    words = [escape(printable(change(text.text(language), language))) for language in LANGUAGES]
    if len(set(words)) == 1:
        return words[0]
    return Markup("").join(
        Markup('<{0} lang="{1}">{2}</{0}>').format(tag, language, each)
        for language, each in zip(LANGUAGES, words, strict=True)
    )


def picture(image: Image.Image, alt: str, quality: int = 75) -> Markup:
    """An RGB image as an <img> element with embedded JPEG data, which opens large in a page.

    The style sheet of the page says how large it is at first.
    """
    data = io.BytesIO()
    image.save(data, "JPEG", quality=quality)
    source = base64.b64encode(data.getvalue()).decode("ascii")
    return Markup('<img src="data:image/jpeg;base64,{0}" alt="{1}" title="{1}"/>').format(
        source, printable(alt)
    )


def _shown(value: object) -> str:
    """What a template shows of a value: a message in all languages."""
    if isinstance(value, Markup):
        return value
    return in_languages(value) if isinstance(value, Message) else printable(str(value))


@cache
def _environment() -> jinja2.Environment:
    import jinja2  # takes as long as all else of this module

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PACKAGE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {
        "t": in_languages,
        "sentence": sentence,
        "message": message,
        "as_message": as_message,
        "plural": plural,
        "duration": duration,
        "picture": picture,
        "content": lambda name: Markup((_PACKAGE / name).read_text(encoding="utf-8")),
    }
    return environment
