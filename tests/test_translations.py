"""The Chinese pages: the check in the documentation build, and their code and formulas."""

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


@pytest.fixture
def docs(tmp_path, translations) -> Path:
    """A small project whose pages are all translated."""
    for name in ("README.md", "docs/quick-start.md", "docs/learn/camera.md", "docs/formats.md"):
        write(tmp_path / name, f"# {name}\n\nSome text\nin two lines.\n")
    for name in translations.OWN:
        write(tmp_path / "docs" / "zh" / name, "# 中文\n")
    for english, chinese in translations.pairs(tmp_path / "docs"):
        digest = translations.digest(english.read_text(encoding="utf-8"))
        write(chinese, f"<!-- translation of {english.name} {digest} -->\n# 标题\n\n文字\n")
    return tmp_path / "docs"


def test_complete_translations_have_no_problems(translations, docs):
    names = [chinese.relative_to(docs.parent) for _, chinese in translations.pairs(docs)]
    assert list(map(str, names)) == [
        "README.zh-CN.md",
        "docs/zh/quick-start.md",
        "docs/zh/learn/camera.md",
    ]
    assert list(translations.problems(docs)) == []


def test_other_line_breaks_are_no_problem(translations, docs):
    write(docs / "quick-start.md", "# docs/quick-start.md\n\nSome text in\ntwo lines.\n")
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


@pytest.mark.parametrize("name", ["README.zh-CN.md", "docs/zh/learn/camera.md"])
def test_a_missing_page_is_a_problem(translations, docs, name):
    (docs.parent / name).unlink()
    (problem,) = translations.problems(docs)
    assert problem.startswith(f"{name}: missing; translate ")


def test_a_page_without_a_digest_or_with_that_of_another_page_is_a_problem(translations, docs):
    write(docs / "zh" / "quick-start.md", "# 标题\n")
    (problem,) = translations.problems(docs)
    assert "does not name the text that it translates" in problem
    digest = translations.digest((docs / "quick-start.md").read_text(encoding="utf-8"))
    write(docs / "zh" / "quick-start.md", f"<!-- translation of camera.md {digest} -->\n# 标题\n")
    (problem,) = translations.problems(docs)
    assert "is a translation of camera.md" in problem


def test_a_page_without_an_english_page_is_a_problem(translations, docs):
    write(docs / "zh" / "learn" / "old.md", "# 旧\n")
    (problem,) = translations.problems(docs)
    assert problem.startswith("docs/zh/learn/old.md: there is no English page of this name")


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


def formulas(text: str) -> set[str]:
    """The formulas within text."""
    text = re.sub(r"^> ?", "", FENCE.sub("", text), flags=re.MULTILINE)
    text = re.sub(r"`[^`\n]+`", "", text)
    text = re.sub(r"\\text\{[^}]*\}", "", text)  # words in a formula
    return {" ".join(formula.split()) for formula in re.findall(r"\$([^$]+)\$", text)}


def test_code_and_formulas_of_every_chinese_page_are_those_of_the_english_page(translations):
    pages = list(translations.pairs(ROOT / "docs"))
    assert len(pages) >= 17
    for english, chinese in pages:
        original = english.read_text(encoding="utf-8")
        translated = chinese.read_text(encoding="utf-8")
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
            if page.name != "README.zh-CN.md" or target.name != "README.md":
                assert target not in pages, f"{page}: {link}: there is a Chinese page"
