"""The parts of report pages: well-formed, escaped, self-contained."""

import xml.etree.ElementTree as ET

import pytest
from PIL import Image

from snowsplat.util import html
from snowsplat.util.duration import duration


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


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0.0 s"), (5.12, "5.1 s"), (99, "99 s"), (130, "2 min 10 s"), (6000, "1 h 40 min")],
)
def test_duration(seconds, words):
    assert duration(seconds) == words
