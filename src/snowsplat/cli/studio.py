"""`snowsplat studio`: makes, shows and hands on scenes, in the browser."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.page_flags import AllowHost
from snowsplat.cli.view import serve
from snowsplat.viewer.hosts import ANY_HOST, is_loopback


@dataclass
class Studio:
    """Make a scene from photos or a video, in the browser.

    Examples:
      snowsplat studio                         scenes are kept in ~/snowsplat_scenes
      snowsplat studio /data/scenes            scenes are kept in this folder
      snowsplat studio --host 0.0.0.0          also for phones in the same network

    Notes:
      Drop photos, a folder, a zip file or a video on the page, or choose a folder
      of this computer. Everything stays on this computer. A scene is made by a
      process of its own: it goes on if the page or the studio is closed, and
      resumes after an interruption. Ctrl-C ends the studio only.
    """

    folder: Annotated[
        Path | None, tyro.conf.Positional, flag("FOLDER", default="~/snowsplat_scenes")
    ] = None
    """The folder of the scenes. It is created if it does not exist."""
    host: Annotated[str, flag("ADDRESS", default="127.0.0.1, this computer only")] = "127.0.0.1"
    """Address to listen on. 0.0.0.0 accepts connections from the network."""
    port: Annotated[int, flag("N", default="a free one")] = 0
    """Port to listen on."""
    allow_host: AllowHost = ()
    no_browser: Annotated[bool, switch()] = False
    """Print the URL, but do not open a browser."""

    def run(self) -> int:
        """Returns the exit code: 0, also after Ctrl-C, the usual end."""
        from snowsplat.studio.app import POLICY, own_address, studio_app
        from snowsplat.studio.library import Library, default_folder
        from snowsplat.viewer.http.server import WebServer

        library = Library(self.folder or default_folder())
        servers: list[WebServer] = []

        def addresses() -> list[str]:
            (server,) = servers
            here = own_address() if self.host in ANY_HOST else self.host
            open_here = here is not None and not is_loopback(here)
            return ([server.url_at(str(here))] if open_here else []) + server.others

        app = studio_app(library, addresses)
        policy = {"Content-Security-Policy": POLICY}
        with (
            suppress(KeyboardInterrupt),
            WebServer(app, self.host, self.port, self.allow_host, policy) as server,
        ):
            servers.append(server)
            print(f"scenes are kept in {library.folder}")
            serve(server, browser=not self.no_browser)
        return 0
