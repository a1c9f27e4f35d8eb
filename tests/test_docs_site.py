"""The documentation site: it can be built without warnings, and describes all public names.

The build takes as long as a hundred other tests, so it is for the night; `make docs` does the same.
"""

import importlib.util
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import snowsplat
from snowsplat import extras
from snowsplat.cli import main as cli

from .cache import cached

extras.register()
ROOT = Path(__file__).resolve().parents[1]
GALLERY = ROOT / "build" / "gallery"

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        importlib.util.find_spec("sphinx") is None, reason="needs Sphinx (make dev installs it)"
    ),
]


def build(folder: Path) -> None:
    """Build the site as `make docs` does."""
    flags = ("--builder", "html", "--fail-on-warning", "--keep-going", "--quiet")
    output = ("--doctree-dir", folder / "doctrees", ROOT / "docs", folder / "html")
    command = [sys.executable, "-m", "sphinx", *flags, *output]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=600)
    assert result.returncode == 0, result.stderr
    assert not result.stderr


@pytest.fixture(scope="module")
def site() -> Path:
    included = [ROOT / "pyproject.toml", *ROOT.glob("*.md")]
    sources = [
        *ROOT.glob("*/README.md"),
        *ROOT.glob("notebooks/*.ipynb"),
        *ROOT.glob("third_party/mathjax-*"),
        *included,
    ]
    for folder in ("docs", "src"):
        files = (ROOT / folder).rglob("*")
        sources += [file for file in files if file.suffix in (".css", ".js", ".md", ".py", ".svg")]
    return cached("docs-site", sources, build) / "html"


class Page(HTMLParser):
    """The targets of the links of a page, and its anchors."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name == "id" and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value:
                self.links.add(value)


def test_every_link_of_the_site_has_a_target(site):
    pages = {file: Page(file) for file in sorted(site.rglob("*.html"))}
    assert len(pages) > 40
    for file, page in pages.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme:
                continue
            target = (file.parent / unquote(address.path)).resolve() if address.path else file
            if target.name.startswith("gallery-") and not GALLERY.is_dir():
                continue  # `make gallery` has not made the scenes
            assert target.exists(), f"{file}: {link}"
            if address.fragment and target in pages:
                assert unquote(address.fragment) in pages[target].anchors, f"{file}: {link}"


def test_no_page_loads_files_from_other_sites(site):
    for file in sorted(site.rglob("*.html")):
        page = file.read_text(encoding="utf-8")
        assert 'src="http' not in page, file
        assert 'rel="stylesheet" type="text/css" href="http' not in page, file


def test_pages_in_two_languages_link_to_each_other(site):
    for page in ("index", "quick-start", "learn/gaussian"):
        english, chinese = site / f"{page}.html", site / "zh" / f"{page}.html"
        for file, other, language in ((english, chinese, "en"), (chinese, english, "zh-CN")):
            text = file.read_text(encoding="utf-8")
            assert f'<html class="no-js" lang="{language}"' in text
            (link,) = re.findall(r'<p class="language"><a href="([^"]*)"', text)
            assert (file.parent / link).resolve() == other
    assert 'class="language"' not in (site / "formats.html").read_text(encoding="utf-8")


def test_every_public_name_is_described(site):
    anchors = Page(site / "api" / "snowsplat.html").anchors
    for name in snowsplat.__all__:
        assert f"snowsplat.{name}" in anchors, name


def test_every_flag_is_described(site, capsys):
    anchors = Page(site / "subcommands.html").anchors
    for name in cli.SUBCOMMANDS:
        with pytest.raises(SystemExit):
            cli.parse([name, "--help"])
        # The flags at the start of a line of the help text, or after a comma.
        help_text = capsys.readouterr().out
        flags = re.findall(r"(?:^\W*|, )--([a-z][a-z0-9-]+)", help_text, re.MULTILINE)
        assert len(flags) > 1
        for flag in set(flags) - {"help"}:
            assert f"cmdoption-snowsplat-{name}-{flag}" in anchors, flag
