"""`snowsplat globe`: a scene in a snow globe."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from snowsplat.cli.flags import Threads, flag
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message


@dataclass
class Globe(Reports):
    """Put a scene into a snow globe: a web page, and a video.

    Examples:
      snowsplat globe out/garden
      snowsplat globe garden.spz -o globe.html --name "Our garden"
      snowsplat globe out/garden --video globe.mp4

    Notes:
      The page is one file and needs no network. Drag the globe to turn it. Shake
      it with the button, the space bar, fast movements of the mouse, or by
      shaking the phone: the Gaussians of the scene whirl and fall as snow.
      Remember (Enter) lets each of them fly home.
      The video shows the same and is rendered without a browser.
    """

    scene: Annotated[Path | None, tyro.conf.Positional, flag("FILE|OUT")] = None
    """A scene file of any format, or the output folder of train or make."""
    output: Annotated[
        Path | None, flag("FILE.html", "-o", default="OUT/globe.html or SCENE_globe.html")
    ] = None
    """The page."""
    video: Annotated[Path | None, flag("FILE.mp4", default="no video")] = None
    """Also write a video."""
    gaussians: Annotated[int, flag("N", "-n", default="100000")] = 100_000
    """Maximum number of Gaussians. The most important ones are used."""
    name: Annotated[str | None, flag("TEXT", default="the name of the scene")] = None
    """Text on the plate of the base."""
    size: Annotated[str | None, flag("WxH|W", default="960x960")] = None
    """Width and height of the video in pixels, or the side of a square."""
    fps: Annotated[float, flag("F", default="30")] = 30.0
    """Frames per second of the video."""
    iteration: Annotated[int | None, flag("N", default="the last step")] = None
    """If OUT contains several scenes, the step after which the scene was saved."""
    threads: Threads = None
    json: JsonFlag = False

    def run(self) -> int:
        if self.scene is None:
            raise UserError("globe needs a scene; use a file or the output folder of a training")
        if self.video is None and self.size is not None:
            raise UserError("`size` is for videos; add --video FILE.mp4")
        from snowsplat.extras.globe.make_globe import GlobeOptions, make_globe

        options = GlobeOptions(self.gaussians, self.name, self.size, self.fps)
        with TerminalObserver() as observer:
            result = make_globe(
                self.scene,
                self.output,
                options,
                video=self.video,
                iteration=self.iteration,
                threads=self.threads,
                observer=observer,
            )
        size = format_bytes(result.page.stat().st_size)
        self.report = result
        print(
            message(
                "{page}: {gaussians:,} Gaussians, {size}",
                page=result.page,
                gaussians=result.gaussians,
                size=size,
            )
        )
        print(
            message(
                "to see it: open {page} in a browser; to share it: send this file", page=result.page
            )
        )
        return 0
