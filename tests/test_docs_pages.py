"""Pages as files: what a plain Markdown renderer shows of them."""

import importlib.util
import itertools
import re
import sys
from pathlib import Path

import pytest

from .browser import Browser, chromium

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FIGURES = DOCS / "learn" / "figures"
COURSE = sorted([*DOCS.glob("learn/*.md"), *DOCS.glob("zh/learn/*.md")])
IMAGE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")
SIZE = re.compile(r'font-size="([\d.]+)"')
LINK = re.compile(r"(?<!!)\[[^\]]*\]\((?![a-z]+:)([^)#\s]*)(?:#([^)\s]*))?\)")


def module(path: Path, *folders: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.path[:0] = map(str, folders)
    try:
        spec.loader.exec_module(loaded)
    finally:
        del sys.path[: len(folders)]
    return loaded


@pytest.fixture(scope="module")
def excerpts():
    return module(DOCS / "excerpts.py")


def test_excerpts_are_current(excerpts):
    assert len(excerpts.pages()) >= 20
    for page in excerpts.pages():
        current = page.read_text(encoding="utf-8") == excerpts.renewed(page)
        assert current, f"{page}: renew the excerpts with: python docs/excerpts.py"


def test_pages_of_the_course_need_no_directive():
    assert len(COURSE) >= 30
    for page in COURSE:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"^\s*(```|:::)\{|\{[a-z:]+\}`~", text, re.MULTILINE), page
        # Within "$…$", GitHub takes a backslash before punctuation for an escape; in a block not.
        assert not re.search(r"^\s*\$\$", text, re.MULTILINE), f"{page}: use a block of math"
        text = re.sub(r"^```.*?^```|`[^`\n]+`", "", text, flags=re.M | re.S)
        for formula in re.findall(r"\$([^$]+)\$", text):
            assert not re.search(r"\\[^A-Za-z]|\*", formula), f"{page}: {formula}"


def test_every_figure_is_a_described_image_in_both_languages():
    shown: dict[str, set[Path]] = {"learn": set(), "zh/learn": set()}
    for page in COURSE:
        for words, target in IMAGE.findall(page.read_text(encoding="utf-8")):
            assert len(words) > 1, f"{page}: {target} has no description"
            chinese = re.search(r"[\u4e00-\u9fff]", words) is not None
            assert chinese == ("zh" in page.parts), f"{page}: {target}: {words}"
            file = (page.parent / target).resolve()
            assert file.exists(), f"{page}: {target}"
            shown[page.parent.relative_to(DOCS).as_posix()].add(file)
    files = set(FIGURES.iterdir()) - set(FIGURES.glob("*.py")) - {FIGURES / "README.md"}
    files = {file for file in files if file.is_file()}
    assert shown["learn"] >= files
    assert shown["zh/learn"] >= files


@pytest.mark.parametrize("folder", ["learn", "zh/learn"])
def test_each_page_of_the_course_ends_with_the_next_one(folder):
    index = (DOCS / folder / "index.md").read_text(encoding="utf-8")
    toctree = re.search(r"<!-- toctree\n((?:.+\n)+?)-->", index)
    assert toctree is not None
    names = toctree[1].split()
    assert len(names) >= 18
    for name, following in itertools.pairwise(names):
        page, target = (DOCS / folder / f"{each}.md" for each in (name, following))
        title = target.read_text(encoding="utf-8").split("# ", 1)[1].split("\n", 1)[0]
        last = page.read_text(encoding="utf-8").rstrip().rsplit("\n\n", 1)[1]
        assert f"[{title}]({following}.md)" in " ".join(last.split()), page


def slugs(page: Path) -> set[str]:
    """The anchors of the headings of a page, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_lead_to_files_and_headings_of_the_repository():
    pages = [*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *ROOT.glob("*/README.md")]
    assert len(pages) > 50
    for page in pages:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for target, anchor in LINK.findall(text):
            file = (page.parent / target).resolve() if target else page
            assert file.exists(), f"{page}: {target}"
            included = file.suffix == ".md" and file.read_text("utf-8").startswith("```{include}")
            assert not included, f"{page}: {target} is on the site only; link to the included file"
            # Headings that a directive makes are on the site only.
            if anchor and "```{" not in file.read_text(encoding="utf-8"):
                assert anchor in slugs(file), f"{page}: {target}#{anchor}"


def test_every_svg_has_colours_for_dark_surroundings():
    drawing = module(FIGURES / "drawing.py")
    css = (DOCS / "static" / "site.css").read_text(encoding="utf-8")
    for name, (light, dark) in drawing.COLOURS.items():
        assert name == "page" or css.count(f"--draw-{name}: {light};") == 1
        assert name == "page" or css.count(f"--draw-{name}: {dark};") == 2
    for file in FIGURES.glob("*.svg"):
        assert drawing.STYLE in file.read_text(encoding="utf-8"), file


@pytest.mark.parametrize("name", ["covariance", "gaussian", "history", "projection", "surfaces"])
def test_figures_are_those_of_their_scripts(name, tmp_path, monkeypatch):
    script = module(FIGURES / f"{name}.py", FIGURES)
    monkeypatch.setattr(sys.modules["drawing"], "FOLDER", tmp_path)
    script.main()
    made = list(tmp_path.glob("*.svg"))
    assert made
    number = re.compile(r"-?\d+\.\d+")
    for file in made:
        new, old = (f.read_text(encoding="utf-8") for f in (file, FIGURES / file.name))
        assert number.sub("#", new) == number.sub("#", old), file.name
        values = zip(number.findall(new), number.findall(old), strict=True)
        assert all(abs(float(a) - float(b)) < 0.25 for a, b in values), file.name


# A plain CommonMark renderer, in a real browser

PANEL = """[...document.images].map(i => [i.src.split('/').pop(), i.naturalWidth, i.width,
    i.getBoundingClientRect().right, i.src.endsWith('.svg')])"""
CUT = """[...document.querySelectorAll('svg')].flatMap(svg => [...svg.querySelectorAll('text')]
    .filter(text => { const b = text.getBBox(), v = svg.viewBox.baseVal;
      return b.x < -1 || b.y < -1 || b.x + b.width > v.width + 1 || b.y + b.height > v.height + 1;
    }).map(text => `${svg.id}: ${text.textContent}`))"""


@pytest.fixture(scope="module", params=[390, 1280])
def browser(request):
    if chromium() is None:
        pytest.skip("needs Chromium")
    with Browser(request.param, 900) as browser:
        yield browser


@pytest.mark.browser
@pytest.mark.nightly
def test_a_plain_renderer_shows_every_figure(browser, tmp_path):
    markdown_it = pytest.importorskip("markdown_it", reason="comes with the documentation tools")
    markdown = markdown_it.MarkdownIt("commonmark").enable("table")
    style = "<style>img{max-width:100%}</style>"  # as GitHub and editors have it
    page = browser.open("about:blank")
    for file in COURSE:
        text = file.read_text(encoding="utf-8")
        html = tmp_path / "page.html"
        head = f'<meta charset="utf-8"><base href="{file.parent.as_uri()}/">{style}'
        html.write_text(f"<!doctype html>{head}{markdown.render(text)}", encoding="utf-8")
        page.navigate(html.as_uri())
        images = page.evaluate(PANEL)
        assert len(images) == len(IMAGE.findall(text)), file
        for name, natural, width, right, svg in images:
            assert natural > 0, f"{file}: {name}"
            assert width > 100, f"{file}: {name}"
            assert right <= browser.width, f"{file}: {name}"
            sizes = (
                [float(s) for s in SIZE.findall((FIGURES / name).read_text("utf-8"))] if svg else []
            )
            assert min(sizes, default=99) * width / natural > 8, (
                f"{file}: the text of {name} is small"
            )


@pytest.mark.browser
def test_no_text_of_a_figure_is_cut(browser, tmp_path):
    if browser.width > 390:
        pytest.skip("does not depend on the width")
    files = sorted(FIGURES.glob("*.svg"))
    parts = [f.read_text().replace("<svg ", f'<svg id="{f.stem}" ', 1) for f in files]
    html = tmp_path / "figures.html"
    html.write_text('<!doctype html><meta charset="utf-8">' + "".join(parts), encoding="utf-8")
    assert browser.open(html.as_uri()).evaluate(CUT) == []
