"""The files of the page of a training; the studio serves them itself, so this needs no torch."""

from pathlib import Path

from snowsplat.util.html import THEME

_PAGE = Path(__file__).parent / "page"
INDEX = "index.html"
#: By name.
FILES = {path.name: path for path in (*_PAGE.iterdir(), THEME)}
#: The content security policy of the page.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
