"""`snowsplat publish`: a static web site that shows a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from snowsplat.cli.flags import Threads, flag, switch
from snowsplat.cli.next_steps import next_step
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message


@dataclass
class Publish(Reports):
    """Write a static web site that shows a scene.

    Examples:
      snowsplat publish out/garden -o site
      snowsplat publish garden.spz -o site --title "Our garden" --licence "CC0"
      snowsplat publish out/garden -o site --url https://example.org/garden

    Notes:
      A scene of more than 2 million Gaussians is written in levels of detail, of
      which browsers load what they show.
      Any web host can serve the folder; nothing has to run there. The page loads
      nothing from other sites. Browsers do not open it from disk: to look at it,
      run snowsplat view site. Over https, browsers with a headset also offer VR
      and AR.
    """

    scene: Annotated[Path | None, tyro.conf.Positional, flag("FILE|OUT")] = None
    """A scene file of any format, or the output folder of train or make."""
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """A new or an empty folder for the web site."""
    title: Annotated[str | None, flag("TEXT", default="the name of the scene")] = None
    """The name of the scene on the page."""
    licence: Annotated[str, flag("TEXT", default="not stated")] = ""
    """The licence of the scene."""
    url: Annotated[str, flag("URL", default="not known")] = ""
    """The address of the folder on the web, for the picture in previews of links."""
    overwrite: Annotated[bool, switch()] = False
    """Replace a web site in FOLDER."""
    iteration: Annotated[int | None, flag("N", default="the last step")] = None
    """If OUT contains several scenes, the step after which the scene was saved."""
    threads: Threads = None
    json: JsonFlag = False

    def run(self) -> int:
        if self.scene is None:
            raise UserError("publish needs a scene; use a file or the output folder of a training")
        if self.output is None:
            raise UserError("publish needs a folder; add -o FOLDER")
        from snowsplat.pipeline.publish import PublishOptions, publish

        with TerminalObserver() as observer:
            result = publish(
                self.scene,
                self.output,
                PublishOptions(self.title, self.licence, self.url),
                iteration=self.iteration,
                overwrite=self.overwrite,
                threads=self.threads,
                observer=observer,
            )
        self.report = result
        print(
            message(
                "{folder}: {gaussians:,} Gaussians, {bytes}",
                folder=result.folder,
                gaussians=result.gaussians,
                bytes=format_bytes(result.bytes),
            )
        )
        look = next_step("to look at it", "view", result.folder)
        print(
            message(
                "{look}; to share it: copy the folder to a web host, and send the address",
                look=look,
            )
        )
        return 0
