"""`snowsplat studio`: makes, shows and hands on scenes, in the browser."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.cli.command import Command, print_message
from snowsplat.cli.pages import PageServer, opener_of, show
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import argument, group
from snowsplat.viewer.hosts import ANY_HOST, LOCAL_HOST, KnownHosts, is_loopback

if TYPE_CHECKING:
    from snowsplat.studio.library import Library
    from snowsplat.studio.one_studio import Address
    from snowsplat.viewer.http.server import WebServer


@dataclass(frozen=True, kw_only=True)
class Studio(Command):
    """Make a scene from photos or a video, in the browser.

    Examples:
      snowsplat studio                         scenes are kept in ~/snowsplat_scenes
      snowsplat studio /data/scenes            scenes are kept in this folder
      snowsplat studio --host 0.0.0.0          also for phones in the same network

    Notes:
      Drop photos, a folder, a zip file or a video on the page, or choose a folder
      of this computer. Everything stays on this computer. A scene is made by a
      process of its own: it goes on if the page or the studio is closed, and
      resumes after an interruption. Ctrl-C ends the studio only. If a studio has
      the folder already, its page is opened.
    """

    folder: Path | None = argument(
        None,
        "FOLDER",
        "The folder of the scenes. It is created if it does not exist.",
        flag="~/snowsplat_scenes",
    )
    server: PageServer = group(PageServer)

    def run(self) -> None:
        """Runs until Ctrl-C, the usual end."""
        from snowsplat.studio.library import Library, default_folder
        from snowsplat.studio.one_studio import Running, only_studio

        if self.folder is not None and self.folder.is_file():
            raise UserError(
                "{file}: is a file; start the studio without it, and drop it on the page",
                file=self.folder,
            )
        library = Library(self.folder or default_folder())
        try:
            with only_studio(library.folder), suppress(KeyboardInterrupt):
                self._serve(library)
        except Running as running:
            self._open(library, running.address)

    def _serve(self, library: Library) -> None:
        from snowsplat.studio.app import POLICY, studio_app
        from snowsplat.studio.library_requests import own_address
        from snowsplat.studio.one_studio import Address, write_address

        servers: list[WebServer] = []

        def addresses() -> list[str]:
            (server,) = servers
            here = own_address() if self.server.host in ANY_HOST else self.server.host
            open_here = here is not None and not is_loopback(here)
            return ([server.url_at(str(here))] if open_here else []) + server.others

        policy = {"Content-Security-Policy": POLICY}
        with self.server.open(studio_app(library, addresses), policy) as server:
            servers.append(server)
            with suppress(OSError):  # a full disk: then a second studio is refused
                where = server.url, self.server.host, server.port, server.token, server.others
                write_address(library.folder, Address(*where, str(opener_of(server.url))))
            print_message("scenes are kept in {folder}", folder=library.folder)
            self.server.serve(server)

    def _open(self, library: Library, address: Address) -> None:
        """Raises: UserError: it has other settings than were asked for."""
        other_host = self.server.host not in (LOCAL_HOST, address.host)
        names = KnownHosts(self.server.host, self.server.allow_host).allowed
        known = all(f"https://{name}/{address.token}/" in address.others for name in names)
        if other_host or not known or self.server.port not in (0, address.port):
            raise UserError(
                "{folder}: is open in another studio, with host {host} and port {port}; end that "
                "one with Ctrl-C first, or omit the flags",
                folder=library.folder,
                host=address.host,
                port=address.port,
            )
        print_message("scenes are kept in {folder}", folder=library.folder)
        show(
            message("a studio has them open already"),
            address.url,
            address.others,
            not self.server.no_browser,
            Path(address.opener),
        )
