"""The Chinese pages: the check in the documentation build, and their code and formulas."""

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXTENSION = ROOT / "docs" / "extensions"


@pytest.fixture(scope="module")
def translations():
    pytest.importorskip("sphinx", reason="needs Sphinx (make dev installs it)")
    sys.path.insert(0, str(EXTENSION))
    try:
        import translations
    finally:
        sys.path.remove(str(EXTENSION))
    return translations


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def write_notebook(path: Path, text: str = "Some text\nin two lines.", code: str = "f()") -> None:
    cells = [("markdown", ["# Title\n", "\n", text]), ("code", [code])]
    cells += [("markdown", "Then:\n\n$$ a = b\\,c $$"), ("code", "g()")]
    listed = [{"cell_type": kind, "source": source} for kind, source in cells]
    write(path, json.dumps({"cells": listed}))


@pytest.fixture
def docs(tmp_path, translations) -> Path:
    """A small project whose pages are all translated."""
    pages = ("README.md", "docs/quick-start.md", "docs/learn/camera.md", "docs/formats.md")
    for name in (*pages, "notebooks/README.md"):
        write(tmp_path / name, f"# {name}\n\nSome text\nin two lines.\n")
    write_notebook(tmp_path / "notebooks" / "01_render.ipynb")
    for name in translations.OWN:
        write(tmp_path / "docs" / "zh" / name, "# 中文\n")
    for english, chinese in translations.pairs(tmp_path / "docs"):
        digest = translations.digest(translations.text_of(english))
        write(chinese, f"<!-- translation of {english.name} {digest} -->\n# 标题\n\n文字\n")
    return tmp_path / "docs"


def test_complete_translations_have_no_problems(translations, docs):
    names = [chinese.relative_to(docs.parent) for _, chinese in translations.pairs(docs)]
    assert list(map(str, names)) == [
        "README.zh-CN.md",
        "docs/zh/guides/notebooks.md",
        "docs/zh/notebooks/01_render.md",
        "docs/zh/quick-start.md",
        "docs/zh/learn/camera.md",
    ]
    assert list(translations.problems(docs)) == []


def test_a_changed_page_is_a_problem_until_the_first_line_is_changed(translations, docs):
    write(docs / "quick-start.md", "# docs/quick-start.md\n\nSome other text.\n")
    (problem,) = translations.problems(docs)
    assert problem.startswith("docs/zh/quick-start.md: older than docs/quick-start.md; update it")
    line = problem.partition(" to ")[2]
    page = docs / "zh" / "quick-start.md"
    _, _, rest = page.read_text(encoding="utf-8").partition("\n")
    write(page, f"{line}\n{rest}")
    assert list(translations.problems(docs)) == []


def test_the_text_of_a_notebook_has_numbers_in_place_of_the_code(translations, docs):
    text = translations.text_of(docs.parent / "notebooks" / "01_render.ipynb")
    first, second = "# Title\n\nSome text\nin two lines.", "Then:\n\n```math\na = b\\,c\n```"
    assert text == f"{first}\n\n`[1]`\n\n{second}\n\n`[2]`\n"


def test_a_page_without_a_digest_or_with_that_of_another_page_is_a_problem(translations, docs):
    write(docs / "zh" / "quick-start.md", "# 标题\n")
    (problem,) = translations.problems(docs)
    assert "does not name the text that it translates" in problem
    digest = translations.digest((docs / "quick-start.md").read_text(encoding="utf-8"))
    write(docs / "zh" / "quick-start.md", f"<!-- translation of camera.md {digest} -->\n# 标题\n")
    (problem,) = translations.problems(docs)
    assert "is a translation of camera.md" in problem


# The pages of this project

FENCE = re.compile(r"^```(.*)\n((?:.*\n)*?)```$", re.MULTILINE)


def blocks(text: str) -> tuple[list[tuple[str, str]], list[str]]:
    """Code and formulas in their own lines, each with the first line of its block; the images."""
    words = re.compile(r"\\text\{[^}]*\}")  # within formulas
    found = [
        (first, " ".join(words.sub("", content).split()) if first == "math" else content)
        for first, content in FENCE.findall(text)
    ]
    images = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    return found, [Path(image).name for image in images]


def outline(text: str) -> list[str]:
    """The levels of the headings, and the numbers of the code cells of a notebook."""
    return re.findall(r"^(#+(?= )|`\[\d+\]`$)", FENCE.sub("", text), re.MULTILINE)


def formulas(text: str) -> set[str]:
    """The formulas within text."""
    text = re.sub(r"^> ?", "", FENCE.sub("", text), flags=re.MULTILINE)
    text = re.sub(r"`[^`\n]+`", "", text)
    text = re.sub(r"\\text\{[^}]*\}", "", text)  # words in a formula
    return {" ".join(formula.split()) for formula in re.findall(r"\$([^$]+)\$", text)}


def test_headings_code_and_formulas_of_every_chinese_page_are_those_of_the_english(translations):
    pages = list(translations.pairs(ROOT / "docs"))
    assert len(pages) >= 40
    for english, chinese in pages:
        original = translations.text_of(english)
        translated = chinese.read_text(encoding="utf-8")
        assert outline(translated) == outline(original), chinese
        assert blocks(translated) == blocks(original), chinese
        assert formulas(translated) == formulas(original), chinese


def test_chinese_pages_link_to_chinese_pages_where_there_are_some(translations):
    pages = dict(translations.pairs(ROOT / "docs"))
    own = [ROOT / "docs" / "zh" / name for name in translations.OWN]
    for page in [*pages.values(), *own]:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for link in re.findall(r"\]\(([^)#:]+\.md)", text):
            target = (page.parent / link).resolve()
            assert target.exists(), f"{page}: {link}"
            assert pages.get(target, page) == page, f"{page}: {link}: there is a Chinese page"
