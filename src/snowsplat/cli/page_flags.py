"""A page in the browser: the flags `--view`, `--port`, `--host`, `--allow-host`; addresses."""

from __future__ import annotations

import getpass
import os
import socket
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, TypeAlias
from urllib.parse import urlsplit

import tyro

from snowsplat.cli.flags import flag
from snowsplat.util.errors import UserError
from snowsplat.viewer.hosts import LOCAL_HOST

if TYPE_CHECKING:
    from snowsplat.pipeline.run.live_page import LivePage

AllowHost: TypeAlias = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    flag("NAME", help="Name of a proxy through which browsers open the page. Can be repeated."),
]


def page_at(
    port: int | None, host: str | None, allow_host: tuple[str, ...], view: bool = True
) -> LivePage | None:
    """The page at the address of these flags, not yet open; None without ``view``.
    Raises: UserError: a port or host without a page, or one that cannot be used.
    """
    if view:
        from snowsplat.pipeline.run.live_page import LivePage

        return LivePage(port, host, allow_host)
    for name, given in (("port", port), ("host", host), ("allow-host", allow_host or None)):
        if given is not None:
            raise UserError(
                "--{name} sets the address of a page; add --view to open one", name=name
            )
    return None


def for_other_computers(url: str, others: Sequence[str]) -> list[str]:
    """Lines that say how other computers open a page: at its other addresses or, if it is only for
    this computer and this shell is a remote one, through a forwarded port."""
    here = urlsplit(url)
    if here.hostname == LOCAL_HOST and not others and over_ssh():
        return [f"from your computer: {_forwarding(here.port)}"]
    return [f"from other computers: {other}" for other in others]


def over_ssh() -> bool:
    """Whether this shell is a remote one."""
    return any(name in os.environ for name in ("SSH_CONNECTION", "SSH_TTY"))


def has_screen() -> bool:
    """Whether a browser opened here has a screen; otherwise a text browser would take the shell."""
    if sys.platform in ("win32", "darwin"):
        return not over_ssh()
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _forwarding(port: int | None) -> str:
    """The command that forwards a port of this machine to the computer of the user."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in containers, a user may have a number only
        user = "USER"
    return f"ssh -L {port}:{LOCAL_HOST}:{port} {user}@{socket.gethostname()}"
