"""The flags of pages in the browser: where they are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from snowsplat.cli.pages import show, wait
from snowsplat.util.errors import UserError
from snowsplat.util.flags import words
from snowsplat.util.messages import message
from snowsplat.util.settings import Settings, same, setting, switch
from snowsplat.viewer.hosts import LOCAL_HOST

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from snowsplat.pipeline.run.live_page import LivePage
    from snowsplat.viewer.http.server import WebServer


@dataclass(frozen=True)
class PageAddress(Settings):
    """The address of a page."""

    port: int | None = setting(
        None,
        "Port of the page. Its URL, which is printed, contains a secret token.",
        "8080, or the next free one",
        metavar="N",
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
    port: int = setting(0, "Port to listen on.", "a free one", metavar="N")
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
