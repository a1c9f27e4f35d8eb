"""`snowsplat view`: a finished scene in the browser."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from snowsplat.cli.command import Command, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.pages import PageServer
from snowsplat.pipeline.options import common
from snowsplat.util.settings import group, needed


@dataclass(frozen=True, kw_only=True)
class View(Command):
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

    path: Path = needed(
        "view needs a scene; add a file or the output folder of a training run",
        "FILE|OUT",
        "A scene file of any format, the output folder of train or make, a folder with levels of "
        "detail, or a site of publish.",
        argument=True,
    )
    iteration: int | None = common.iteration()
    server: PageServer = group(PageServer)

    def run(self) -> None:
        """Runs until Ctrl-C, the usual end."""
        from snowsplat.pipeline.publish import viewed_scene
        from snowsplat.viewer.http.static import static_app

        with (
            TerminalObserver() as observer,
            viewed_scene(self.path, self.iteration, observer) as scene,
            suppress(KeyboardInterrupt),
            self.server.open(static_app(scene.files), scene.headers) as server,
        ):
            if scene.gaussians is None:
                print_message("{file}: a web site", file=scene.file)
            else:
                count = scene.gaussians
                print_message("{file}: {count:,} Gaussians", file=scene.file, count=count)
            self.server.serve(server)
