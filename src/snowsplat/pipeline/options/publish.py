"""`PublishOptions`: what one can set of a web site."""

from __future__ import annotations

import re
from dataclasses import dataclass

from snowsplat.util.settings import Settings, setting


def _problem(url: str) -> str | None:
    known = not url or re.fullmatch(r"https?://[^\s\"<>?#]+", url)
    return None if known else "is no address; use e.g. https://host/garden/"


@dataclass(frozen=True)
class PublishOptions(Settings):
    """Options of a published scene.

    Attributes:
        title: None: the name of the scene.
        licence: such as "CC BY 4.0".
        for_editing: the page is not to be looked at: it has all Gaussians, even of a large scene,
            without what their colours owe to the direction of view.

    Raises:
        UserError: the address is not one.
    """

    title: str | None = setting(
        None, "The name of the scene on the page.", "the name of the scene", metavar="TEXT"
    )
    licence: str = setting("", "The licence of the scene.", "not stated", metavar="TEXT")
    url: str = setting(
        "",
        "The address of the folder on the web, for the picture in previews of links.",
        "not known",
        check=_problem,
        metavar="URL",
    )
    for_editing: bool = False
