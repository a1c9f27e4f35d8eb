"""Formulas are drawn by MathJax, which is part of the site.

`sphinx.ext.mathjax` would load MathJax from another server. This extension unpacks it from the
archive in `third_party` into the site, so that pages need no network connection (`mathjax_path` in
`conf.py`). Formulas become SVG, because some browsers do not load fonts for pages that are opened
as files.
"""

import hashlib
import tarfile
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

_ARCHIVE = Path(__file__).resolve().parents[2] / "third_party" / "mathjax-3.2.2.tar.xz"
_SHA256 = "ff8448ba7c23df6e2b69146984fa094361b6c3dfe66ebab0493acf4b3dc4ad93"


def _unpack(app: Sphinx) -> None:
    if app.builder.format != "html":
        return
    if hashlib.sha256(_ARCHIVE.read_bytes()).hexdigest() != _SHA256:
        raise ExtensionError(f"{_ARCHIVE}: damaged or changed; restore it with git checkout")
    with tarfile.open(_ARCHIVE) as archive:
        archive.extractall(Path(app.outdir) / "_static")


def setup(app: Sphinx) -> dict[str, Any]:
    app.setup_extension("sphinx.ext.mathjax")
    app.connect("builder-inited", _unpack)
    return {"parallel_read_safe": True}
