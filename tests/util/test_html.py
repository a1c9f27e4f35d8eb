"""The parts of report pages: well-formed, escaped, self-contained."""

import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from gettext import NullTranslations
from pathlib import Path

import pytest
from jinja2 import UndefinedError
from PIL import Image

import snowsplat
from snowsplat.util import html, messages
from snowsplat.util.duration import duration
from snowsplat.util.html import THEME, colours, with_colours
from snowsplat.util.messages import message, plural

from ..browser import Browser


def rendered(template: str, **values) -> str:
    """A page whose body is a template."""
    head = '{% extends "util/report/report.html.j2" %}'
    head += '{% from "util/report/parts.html.j2" import bar, cards, facts, table %}'
    source = f"{head}{{% block main %}}{template}{{% endblock %}}"
    return html._environment().from_string(source).render(title="a page", **values)


def test_page_is_xml_for_any_text():
    nasty = "a <b> & 'c' \"d\" \x00\x1b \udcff 雪"
    page = rendered(
        """<h1>{{ name }}</h1>{{ cards([(name, "words")]) }}
        {% call table(["head"], "names") %}<tr><td>{{ bar(0.5) }}</td></tr>{% endcall %}
        {{ facts([("about", name)]) }}{{ picture(image, name) }}
        {{ t("{path}: no such file", path=name) }}""",
        name=nasty,
        image=Image.new("RGB", (8, 6)),
    )
    root = ET.fromstring(page)
    body = "".join(root.find("body/main").itertext())
    assert body.count("a <b> & 'c' \"d\"") >= 4
    assert root.find(".//table[@class='facts']/tbody/tr/th").text == "about"
    assert root.find(".//img").get("src").startswith("data:image/jpeg;base64,")
    assert root.find(".//img").get("alt").startswith("a <b>")


def test_a_value_that_is_missing_is_an_error():
    with pytest.raises(UndefinedError):
        rendered("{{ nothing }}")


def a_page(folder):
    """A page with two pictures, a table of eight columns, and long words, which is opened."""
    template = """<style>main img { height: 110px; }</style>
    <h1>a_very_long_name_of_a_folder_without_spaces_in_it</h1>
    {% for colour in ("red", "blue") %}{{ picture(images[colour], colour) }}{% endfor %}
    {% call table(["a column"] * 8) %}
    <tr>{% for _ in range(7) %}<td>1.234&#160;dB</td>{% endfor %}<td>{{ bar(1.0) }}</td></tr>
    {% endcall %}
    {{ facts([("degree of the spherical harmonics", "0123456789abcdef " * 8)]) }}"""
    images = {colour: Image.new("RGB", (900, 600), colour) for colour in ("red", "blue")}
    path = folder / "page.html"
    path.write_text(rendered(template, images=images), encoding="utf-8")
    return path.as_uri()


@pytest.mark.browser
def test_a_page_fits_a_phone(tmp_path):
    with Browser(390, 844) as browser:
        page = browser.open(a_page(tmp_path))
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert not page.errors


@pytest.mark.browser
def test_pictures_open_large_by_click_and_key(tmp_path):
    """Escape is left to the browser; the arrow keys show the next picture."""
    shown = "document.querySelector('dialog[open] img')?.alt ?? ''"

    def press(key):
        event = f"new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}})"
        return page.evaluate(f"document.activeElement.dispatchEvent({event}), {shown}")

    with Browser(800, 600) as browser:
        page = browser.open(a_page(tmp_path))
        page.evaluate("document.querySelectorAll('main img')[0].click()")
        assert page.evaluate(shown) == "red"
        assert page.evaluate("document.querySelector('dialog img').height") > 500
        page.evaluate("document.querySelector('dialog').click()")
        assert page.evaluate(shown) == ""
        page.evaluate("document.querySelectorAll('main img')[1].focus()")
        assert press("Enter") == "blue"
        assert page.evaluate("document.querySelector('dialog').contains(document.activeElement)")
        assert press("ArrowRight") == "red"
        assert not page.errors


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0.0 s"), (5.12, "5.1 s"), (99, "99 s"), (130, "2 min 10 s"), (6000, "1 h 40 min")],
)
def test_duration(seconds, words):
    assert str(duration(seconds)) == words


@pytest.fixture
def chinese(monkeypatch):
    """A small Chinese catalogue."""
    texts = {"No photo is blurred.": "没有模糊的照片。", "{n} photo": "{n} 张照片", "steps": "步"}

    class Catalogue(NullTranslations):
        def gettext(self, text):
            return texts.get(text, text)

        def ngettext(self, one, many, n):
            return texts.get(one, one)

    catalogues = {"en": NullTranslations(), "zh": Catalogue()}
    monkeypatch.setattr(messages, "_catalogue", catalogues.__getitem__)


def test_texts_in_languages(chinese):
    assert html.in_languages("a text & another") == "a text &amp; another"
    photos = html.in_languages("{photos}, <i>", photos=plural("{n} photo", "{n} photos", n=2))
    assert photos == (
        '<span lang="en">2 photos, &lt;i&gt;</span><span lang="zh">2 张照片, &lt;i&gt;</span>'
    )
    assert html.sentence(message("steps"), stop=True) == (
        '<span lang="en">Steps.</span><span lang="zh">步。</span>'
    )
    assert html.svg_text(message("steps")).startswith('<tspan lang="en">steps</tspan>')


@pytest.mark.browser
def test_a_browser_shows_its_language_and_a_button_the_other_one(chinese, tmp_path):
    path = tmp_path / "page.html"
    template = """<p>{{ t("No photo is blurred.") }}</p><p>{{ t("another text") }}</p>
    <svg width="90" height="30"><text y="20">{{ label }}</text></svg>"""
    path.write_text(rendered(template, label=html.svg_text(message("steps"))), encoding="utf-8")
    shown = "[...document.querySelectorAll('p, tspan')].filter(e => e.checkVisibility())"
    texts = f"{shown}.map(e => e.innerText ?? e.textContent)"
    with Browser() as browser:
        page = browser.open(path.as_uri(), language="zh-CN")
        assert page.evaluate(texts) == ["没有模糊的照片。", "another text", "步"]
        assert page.evaluate("document.documentElement.lang") == "zh-CN"
        page.evaluate("document.querySelector('.language').click()")
        assert page.evaluate(texts) == ["No photo is blurred.", "another text", "steps"]
        assert page.evaluate("document.documentElement.lang") == "en"
        page.navigate(f"{path.as_uri()}?lang=en&theme=dark")
        assert page.evaluate("document.documentElement.lang") == "en"
        assert page.evaluate("document.documentElement.style.colorScheme") == "dark"
        assert not page.errors


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
