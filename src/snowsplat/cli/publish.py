"""`snowsplat publish`: a static web site that shows a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.scene import PublishOptions
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import group, needed, switch


@dataclass(frozen=True, kw_only=True)
class Publish(JsonCommand):
    """Write a static web site that shows a scene.

    Examples:
      snowsplat publish out/garden -o site
      snowsplat publish garden.spz -o site --title "Our garden" --licence "CC0"
      snowsplat publish out/garden -o site --url https://example.org/garden
      snowsplat publish data/garden -o garden.html --trainable

    Notes:
      A scene of more than 2 million Gaussians is written in levels of detail, of
      which browsers load what they show.
      Any web host can serve the folder; nothing has to run there. The page loads
      nothing from other sites. Browsers do not open it from disk: to look at it,
      run snowsplat view site. Over https, browsers with a headset also offer VR
      and AR.
      With --trainable, DATASET becomes a single HTML file with its photos, cameras
      and points. The page trains a scene while one watches, on the GPU of whoever
      opens it: the browser needs WebGPU, and nothing is sent anywhere.
    """

    scene: Path = needed(
        "publish needs a scene; use a file or the output folder of a training",
        "FILE|OUT|DATASET",
        "A scene file of any format, or the output folder of train or make; with --trainable, a "
        "dataset.",
        argument=True,
    )
    output: Path = needed(
        "publish needs a folder; add -o FOLDER",
        "FOLDER",
        "A new or an empty folder for the web site; with --trainable, an HTML file.",
        "-o",
    )
    options: PublishOptions = group(PublishOptions)
    trainable: bool = switch(
        "Write a page that trains DATASET in the browser, instead of showing a scene."
    )
    overwrite: bool = common.overwrite("Replace a web site in FOLDER, or the page that trains.")
    iteration: int | None = common.iteration()
    compute: Compute = group(Compute, only=("threads",))

    def run(self) -> Any:
        if self.trainable:
            return self._run_trainable()
        from snowsplat.pipeline.publish import publish

        with TerminalObserver() as observer:
            result = publish(
                self.scene,
                self.output,
                self.options,
                iteration=self.iteration,
                overwrite=self.overwrite,
                threads=self.compute.threads,
                observer=observer,
            )
        print_message(
            "{folder}: {gaussians:,} Gaussians, {bytes}",
            folder=result.folder,
            gaussians=result.gaussians,
            bytes=format_bytes(result.bytes),
        )
        look = next_step(message("to look at it"), "view", result.folder)
        print_message(
            "{look}; to share it: copy the folder to a web host, and send the address", look=look
        )
        return result

    def _run_trainable(self) -> Any:
        from snowsplat.pipeline.publish_trainable import publish_trainable

        options = {
            "--licence": bool(self.options.licence),
            "--url": bool(self.options.url),
            "--walk": self.options.walk,
            "--iteration": self.iteration is not None,
        }
        unused = [flag for flag, given in options.items() if given]
        if unused:
            raise UserError("{flag}: is not for --trainable; leave it out", flag=unused[0])
        with TerminalObserver() as observer:
            result = publish_trainable(
                self.scene,
                self.output,
                self.options.title,
                overwrite=self.overwrite,
                threads=self.compute.threads,
                observer=observer,
            )
        print_message(
            "{page}: {photos} photos, {gaussians:,} Gaussians to begin with, {bytes}; open it in a "
            "browser with WebGPU",
            page=result.page,
            photos=result.photos,
            gaussians=result.gaussians,
            bytes=format_bytes(result.bytes),
        )
        return result
