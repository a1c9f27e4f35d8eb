"""The parts of report pages: well-formed, escaped, self-contained."""

import ast
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from PIL import Image

import snowsplat
from snowsplat.util import html
from snowsplat.util.duration import duration

from ..browser import Browser


def test_page_is_xml_for_any_text():
    nasty = "a <b> & 'c' \"d\" \x00\x1b \udcff 雪"
    parts = [
        html.cards([(html.text(nasty), "words")]),
        "",
        html.table(["head"], [[html.text(nasty)], [html.bar(0.5)]], "names"),
        html.table([], [["about", html.text(nasty)]]),
        html.picture(Image.new("RGB", (8, 6)), nasty),
    ]
    page = html.page(nasty, parts, ".own { color: red; }")
    root = ET.fromstring(page)
    body = "".join(root.find("body").itertext())
    assert body.count("a <b> & 'c' \"d\"") == 3
    assert root.find(".//table[@class='facts']/tbody/tr/th").text == "about"
    assert root.find("head/title").text.startswith("a <b> &")
    assert "<b>" not in page.replace("<b>a &lt;b&gt;", "")  # except that of the card
    assert ".own { color: red; }" in page
    assert root.find(".//img").get("src").startswith("data:image/jpeg;base64,")
    assert root.find(".//img").get("alt").startswith("a <b>")


def a_page(folder):
    """A page with two pictures, a table of eight columns, and long words, which is opened."""
    pictures = [
        html.picture(Image.new("RGB", (900, 600), color), color) for color in ("red", "blue")
    ]
    wide = html.table(["a column"] * 8, [["1.234&#160;dB"] * 7 + [html.bar(1.0)]])
    facts = html.table([], [["degree of the spherical harmonics", "0123456789abcdef " * 8]])
    style = "main img { height: 110px; }"
    path = folder / "page.html"
    parts = ["<h1>a_very_long_name_of_a_folder_without_spaces_in_it</h1>", *pictures, wide, facts]
    path.write_text(html.page("a page", parts, style), encoding="utf-8")
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


def test_a_page_without_pictures_has_no_script_for_them():
    assert "showModal" not in html.page("a page", ["<p>words</p>"])


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0.0 s"), (5.12, "5.1 s"), (99, "99 s"), (130, "2 min 10 s"), (6000, "1 h 40 min")],
)
def test_duration(seconds, words):
    assert duration(seconds) == words


@pytest.mark.browser
def test_a_browser_in_chinese_shows_chinese_except_for_names_commands_and_other_text(tmp_path):
    parts = [
        "<h1>photos</h1>",
        "<p>No photo is blurred, too dark or too bright.</p>",
        "<p>A sentence. Evaluated on 5 photos of 800x600 that were not used for training.</p>",
        "<ul><li>Also: 3 of 40 photos could not be placed</li><li>something else</li></ul>",
        html.table(["photo", "reason"], [["good.jpg", "it matches no other photo"]]),
        html.table(
            [], [["level", "from the ground and the compasses of 1,234 photos, to about 2°"]]
        ),
        "<pre>photos</pre>",
    ]
    path = tmp_path / "page.html"
    path.write_text(html.page("a page", parts), encoding="utf-8")
    shown = "document.querySelector('main').innerText.split(/\\s*[\\n\\t]\\s*/)"
    chinese = [
        "photos",
        "没有模糊、太暗或太亮的照片。",
        "A sentence. 在没有参加训练的 5 张照片（800x600）上评估。",
        "另外：40 张照片中有 3 张无法求出位姿",
        "something else",
        *("照片", "原因"),
        *("good.jpg", "它与其他照片都不匹配"),
        *("水平", "由地面和 1,234 张照片的罗盘求出，误差约 2°"),
        "photos",
    ]
    with Browser() as browser:
        page = browser.open(path.as_uri(), language="zh-CN")
        assert page.evaluate(shown) == chinese
        assert page.evaluate("document.documentElement.lang") == "zh-CN"
        page.evaluate("document.querySelector('.language').click()")
        assert page.evaluate(shown)[2].endswith(
            "Evaluated on 5 photos of 800x600 that were not used for training."
        )
        assert page.evaluate("document.documentElement.lang") == "en"
        assert not page.errors


def strings(file: Path) -> list[str]:
    """All strings of a module; what an f-string inserts is a line break."""

    def value(node: ast.AST) -> str:
        if isinstance(node, ast.JoinedStr):
            return "".join(map(value, node.values))
        return node.value if isinstance(node, ast.Constant) else "\n"

    nodes = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    return [text for node in nodes if isinstance(text := value(node), str)]


def test_every_text_with_a_translation_exists():
    """A changed text would be shown in English. Single words are not looked for."""
    source = Path(snowsplat.__file__).parent
    known = "\n".join(text for file in source.rglob("*.py") for text in strings(file)).lower()
    script = (source / "util" / "chinese.js").read_text(encoding="utf-8")
    translated = re.findall(r"^ {8}'(.*?)':", script, re.MULTILINE)
    assert len(translated) > 100
    for text in translated:
        for words in re.split(r"[#{}%°(),.;:/]", text.lower()):
            assert " " not in words.strip() or words.strip() in known, text
