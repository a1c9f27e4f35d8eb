"""`snowsplat globe`: a scene in a snow globe."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.extras.globe.options import GlobeOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.settings import group, needed, setting


@dataclass(frozen=True, kw_only=True)
class Globe(JsonCommand):
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

    scene: Path = needed(
        "globe needs a scene; use a file or the output folder of a training",
        "FILE|OUT",
        "A scene file of any format, or the output folder of train or make.",
        argument=True,
    )
    output: Path | None = setting(
        None,
        "The page.",
        "OUT/globe.html or SCENE_globe.html",
        metavar="FILE.html",
        aliases=("-o",),
    )
    video: Path | None = setting(None, "Also write a video.", "no video", metavar="FILE.mp4")
    options: GlobeOptions = group(GlobeOptions)
    iteration: int | None = common.iteration()
    compute: Compute = group(Compute, only=("threads",))

    def run(self) -> Any:
        if self.video is None and self.options.size is not None:
            raise UserError("`size` is for videos; add --video FILE.mp4")
        from snowsplat.extras.globe.make_globe import make_globe

        with TerminalObserver() as observer:
            result = make_globe(
                self.scene,
                self.output,
                self.options,
                video=self.video,
                iteration=self.iteration,
                threads=self.compute.threads,
                observer=observer,
            )
        size = format_bytes(result.page.stat().st_size)
        print_message(
            "{page}: {gaussians:,} Gaussians, {size}",
            page=result.page,
            gaussians=result.gaussians,
            size=size,
        )
        print_message(
            "to see it: open {page} in a browser; to share it: send this file", page=result.page
        )
        return result
