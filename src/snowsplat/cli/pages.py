"""Pages in the browser: the flags for their addresses, and how they are opened."""

from __future__ import annotations

import atexit
import getpass
import html
import os
import shutil
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from snowsplat.cli.command import print_message
from snowsplat.util.errors import UserError
from snowsplat.util.flags import words
from snowsplat.util.messages import Message, message
from snowsplat.util.settings import Settings, flag, same, setting, switch
from snowsplat.viewer.hosts import LOCAL_HOST

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from snowsplat.pipeline.run.live_page import LivePage
    from snowsplat.viewer.http.server import WebServer

_OPENING_SECONDS = 5.0  # in which a browser gets its address


def for_other_computers(url: str, others: Sequence[str]) -> list[Message]:
    """Lines that say how other computers open a page: at its other addresses or, if it is only for
    this computer and this shell is a remote one, through a forwarded port."""
    here = urlsplit(url)
    if here.hostname == LOCAL_HOST and not others and over_ssh():
        return [message("from your computer: {command}", command=_forwarding(here.port))]
    return [message("from other computers: {url}", url=other) for other in others]


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


def show(
    how: Message, url: str, others: Sequence[str], browser: bool, opener: Path | None = None
) -> None:
    """Print the addresses of a page, and open it if there is a ``browser`` and a screen.

    ``opener``: the `opener_of` another process that shows the page; None: this process shows it.
    """
    print_message("{how}: {url}", how=how, url=url)
    for line in for_other_computers(url, others):
        print_message(line)
    if browser and has_screen():
        import webbrowser

        with suppress(OSError):  # a full disk: the address is printed
            place = (opener or opener_of(url)).as_uri()
            # In the background: some browsers block the program that opens them.
            opening = threading.Thread(target=webbrowser.open, args=(place,), daemon=True)
            opening.start()
            if opener:  # this process ends at once
                opening.join(_OPENING_SECONDS)


@cache
def opener_of(url: str) -> Path:
    """A file that leads a browser to ``url``, until this process ends. Only its user can read it.

    All users see the words of a command, such as that of the browser, and ``url`` has a secret.

    Raises: OSError: it cannot be written.
    """
    # Browsers in packages of snap read no other folders of temporary files than their own.
    visible = os.path.expanduser("~") if Path("/snap").is_dir() else None
    folder = Path(tempfile.mkdtemp(prefix="snowsplat-", dir=visible))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    file, link = folder / "open.html", html.escape(url)
    with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as page:
        page.write(
            f'<meta http-equiv="refresh" content="0; url={link}"><a href="{link}">snowsplat</a>'
        )
    return file


def wait() -> None:
    """Wait for Ctrl-C, which arrives only between two waits on Windows."""
    while True:
        time.sleep(1.0)


@dataclass(frozen=True)
class PageAddress(Settings):
    """The address of a page."""

    port: int | None = flag(
        None,
        "Port of the page. Its URL, which is printed, contains a secret token.",
        "8080, or the next free one",
    )
    host: str | None = setting(
        None,
        "Address to listen on. 0.0.0.0 accepts connections from the network.",
        "127.0.0.1, this computer only",
        metavar="H",
    )
    allow_host: tuple[str, ...] = setting(
        (),
        "Name of a proxy through which browsers open the page. Can be repeated.",
        repeated=True,
        metavar="NAME",
    )

    def page(self, view: bool = True) -> LivePage | None:
        """The page at this address, not yet open; None without ``view``.

        Raises: UserError: a port or host without a page, or one that cannot be used.
        """
        if view:
            from snowsplat.pipeline.run.live_page import LivePage

            return LivePage(self.port, self.host, self.allow_host)
        if given := words(PageAddress, asdict(self)):
            raise UserError(
                "{given} sets the address of a page; add --view to open one", given=given[0]
            )
        return None


@dataclass(frozen=True)
class PageServer(Settings):
    """Where a finished scene or the studio is shown."""

    host: str = setting(
        LOCAL_HOST,
        "Address to listen on. 0.0.0.0 accepts connections from the network.",
        "127.0.0.1, this computer only",
        metavar="ADDRESS",
    )
    port: int = flag(0, "Port to listen on.", "a free one")
    allow_host: tuple[str, ...] = same(PageAddress, "allow_host", ())
    no_browser: bool = switch("Print the URL, but do not open a browser.")

    def open(self, app: ASGIApp, headers: Mapping[str, str]) -> WebServer:
        """The server. Raises: UserError: the address cannot be used."""
        from snowsplat.viewer.http.server import WebServer

        return WebServer(app, self.host, self.port, self.allow_host, headers)

    def serve(self, server: WebServer) -> None:
        """Show a page, see `show`, and wait for Ctrl-C."""
        how = message("open this in a browser, Ctrl-C ends it")
        show(how, server.url, server.others, not self.no_browser)
        wait()
