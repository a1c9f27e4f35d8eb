"""`snowsplat view`: a finished scene in the browser."""

from __future__ import annotations

import threading
import time
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.page_flags import AllowHost, for_other_computers, has_screen
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.viewer.http.server import WebServer


@dataclass
class View:
    """Show a finished scene in the browser.

    Examples:
      snowsplat view out/garden
      snowsplat view garden.spz
      snowsplat view site                      the folder of snowsplat publish
      snowsplat view out/garden --no-browser --port 8080

    Notes:
      Drag the mouse to rotate, scroll to zoom, press W A S D to fly. The page
      lists all controls. The initial view is that of the first training photo.
      By default, the page can be opened only on this computer. Its URL contains a
      secret token. Ctrl-C stops the viewer.
      A folder with levels of detail (lod-meta.json, see convert) opens at once.
      For other scenes of more than 4 million Gaussians, the levels are written
      first, which takes minutes.
    """

    path: Annotated[Path | None, tyro.conf.Positional, flag("FILE|OUT")] = None
    """A scene file of any format, the output folder of train or make, a folder with levels of
    detail, or a site of publish."""
    iteration: Annotated[int | None, flag("N", default="the last step")] = None
    """If OUT contains several scenes, the step after which the scene was saved."""
    host: Annotated[str, flag("ADDRESS", default="127.0.0.1, this computer only")] = "127.0.0.1"
    """Address to listen on. 0.0.0.0 accepts connections from the network."""
    port: Annotated[int, flag("N", default="a free one")] = 0
    """Port to listen on."""
    allow_host: AllowHost = ()
    no_browser: Annotated[bool, switch()] = False
    """Print the URL, but do not open a browser."""

    def run(self) -> int:
        """Returns the exit code: 0, also after Ctrl-C, the usual end."""
        if self.path is None:
            raise UserError("view needs a scene; add a file or the output folder of a training run")
        from snowsplat.pipeline.view import viewed_scene
        from snowsplat.viewer.http.server import WebServer
        from snowsplat.viewer.http.static import static_app

        with (
            TerminalObserver() as observer,
            viewed_scene(self.path, self.iteration, observer) as scene,
            suppress(KeyboardInterrupt),
            WebServer(
                static_app(scene.files), self.host, self.port, self.allow_host, scene.headers
            ) as server,
        ):
            site = scene.gaussians is None
            print(
                message(
                    "{file}: {value}",
                    file=scene.file,
                    value="a web site" if site else f"{scene.gaussians:,} Gaussians",
                )
            )
            serve(server, browser=not self.no_browser)
        return 0


def serve(server: WebServer, browser: bool) -> None:
    """Show a page, see `show`, and wait for Ctrl-C."""
    show("open this in a browser, Ctrl-C ends it", server.url, server.others, browser)
    wait()


def show(how: str, url: str, others: Sequence[str], browser: bool) -> None:
    """Print the addresses of a page, and open it if there is a ``browser`` and a screen."""
    print(message("{how}: {url}", how=how, url=url), flush=True)
    for line in for_other_computers(url, others):
        print(line, flush=True)
    if browser and has_screen():
        open_browser(url)


def open_browser(url: str) -> None:
    """In the background: some browsers block the program that opens them."""
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


def wait() -> None:
    """Wait for Ctrl-C, which arrives only between two waits on Windows."""
    while True:
        time.sleep(1.0)
