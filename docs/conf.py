"""Settings of the documentation site, which `make docs` builds with Sphinx."""

import sys
from pathlib import Path

_DOCS = Path(__file__).parent
sys.path[:0] = [str(_DOCS / "extensions"), str(_DOCS.parent / "src")]

from snowsplat import __version__  # noqa: E402

project = "snowsplat"
author = "snowsplat authors"
release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "api_names",
    "docstrings",
    "local_mathjax",
    "plain_markdown",
    "reference_flags_table",
    "repository_links",
    "settings_table",
    "subcommand_help",
    "translations",
]
exclude_patterns = ["extensions", "static", "learn/figures"]

# Pages
mathjax_path = "mathjax/tex-svg.js"
mathjax3_config = {"svg": {"fontCache": "global"}, "options": {"enableMenu": False}}
smartquotes = False  # would change the hyphens of flags
myst_heading_anchors = 4
myst_fence_as_directive = ["math"]
myst_enable_extensions = ["dollarmath"]
html_theme = "furo"
html_title = f"snowsplat {release}"
html_static_path = ["static"]
# The scenes of the gallery, if docs/gallery.py has made them.
_GALLERY = _DOCS.parent / "build" / "gallery"
html_extra_path = [str(_GALLERY)] if _GALLERY.is_dir() else []
html_css_files = ["site.css"]
html_js_files = [
    ("basin.js", {"defer": "defer"}),
    ("interactive/interactive.js", {"defer": "defer"}),
]
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False
pygments_style = "tango"

# API
autoclass_content = "both"
autodoc_default_options = {"member-order": "bysource"}
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
add_module_names = False
toc_object_entries_show_parents = "hide"
default_role = "py:obj"

# Every reference must have a target, except:
nitpicky = True
nitpick_ignore_regex = [
    # names in docstrings that no page describes: they are shown as code
    ("py:obj", ".*"),
    # types of Python and of libraries, private types, and names of literals
    (
        "py:class",
        r"(torch|np|numpy|PIL|Image|collections|datetime|typing|contextlib|os|pathlib)\..*|Path|Tensor",
    ),
    ("py:class", r".*\._\w+|Color|Depth|Split"),
    # types of snowsplat that are not public: the API pages describe the public names only
    (
        "py:class",
        r"snowsplat\..*|Alignment|Batch|DatasetSettings|DepthKind|Gradients|LivePage|Moment",
    ),
    ("py:class", r"Message|PartSection|PlacedPhoto|Reason|Section|Shards|Start"),
]
