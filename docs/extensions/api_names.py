"""Names of snowsplat in annotations and docstrings become links to their descriptions.

The API pages describe a public name once, for example `Observer` as `snowsplat.Observer`. Source
files use it as `Observer` or as `snowsplat.pipeline.observer.Observer`. This extension finds the
description by the last part of the name, if only one object has this name. A name that `snowsplat`
exports means that object, except on the pages of `snowsplat.ops`, which has a `View` of its own.
The extension leaves these names out of the pages of other packages.
"""

from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

import snowsplat


def _resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    if node.get("refdomain") != "py":
        return None
    last = node["reftarget"].rpartition(".")[2]
    objects = env.domaindata["py"]["objects"]
    found = {
        (entry.docname, entry.node_id)
        for name, entry in objects.items()
        if name.rpartition(".")[2] == last and entry.objtype in _KINDS
    }
    if len(found) != 1:
        return None
    ((page, anchor),) = found
    return make_refnode(app.builder, node["refdoc"], page, anchor, content, node["reftarget"])


def _qualify(app: Sphinx, doctree: nodes.document) -> None:
    for node in doctree.findall(pending_xref):
        own = str(node.get("py:module")).startswith("snowsplat.ops")
        if node.get("refdomain") == "py" and node["reftarget"] in snowsplat.__all__ and not own:
            node["reftarget"] = f"snowsplat.{node['reftarget']}"


def _skip(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    public = snowsplat.__all__
    return True if name in public and getattr(snowsplat, name) is obj else None


_KINDS = ("class", "exception", "function", "data")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("doctree-read", _qualify)
    app.connect("missing-reference", _resolve)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True}
