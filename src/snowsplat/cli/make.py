"""`snowsplat make`: photos or a video become a scene, in one command."""

from __future__ import annotations

import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.cli.command import Exit, JsonCommand, print_message, see_and_share
from snowsplat.cli.config_file import config
from snowsplat.cli.observer import TerminalObserver, WatchObserver
from snowsplat.cli.pages import PageAddress
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.stage_lines import photos_of_last_part
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.flags import command_line, with_flags, words
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.settings import argument, group, setting, switch

if TYPE_CHECKING:
    from snowsplat.pipeline.run.live_page import LivePage
    from snowsplat.pipeline.run.results import MakeResult


@dataclass(frozen=True, kw_only=True)
class Make(JsonCommand):
    """Make a scene from photos or a video: sfm, train and render in one command.

    Examples:
      snowsplat make photos/                   the scene is photos_scene/photos.ply
      snowsplat make walk.mp4 -o walk          the scene is walk/walk.ply
      snowsplat make photos/ --quality best    slower: larger photos, more Gaussians
      snowsplat make photos/ --minutes 5       finish within 5 minutes

    Notes:
      OUT/dataset contains the photos, their cameras and a report. OUT/scene is
      the output folder of the training. OUT/scene/test/ours_N contains the
      held-out photos and renders of the same views; N is the number of steps.
      If the command is interrupted, run it again to resume. Finished stages are
      repeated only if the photos or the settings change.
    """

    inputs: tuple[Path, ...] = argument(
        (),
        "INPUT [INPUT ...]",
        "One or more photos (JPEG, PNG, WebP, TIFF, HEIC), folders of photos, or videos. The "
        "camera poses of a dataset are used, if its folder is the only input and they are "
        "plausible.",
    )
    output: Path | None = setting(
        None,
        "Output folder. It is created if it does not exist.",
        "./INPUT_scene",
        metavar="OUT",
        aliases=("-o",),
    )
    config: Path | None = config()
    options: MakeOptions = group(MakeOptions)
    overwrite: bool = common.overwrite(
        "Replace the scene in OUT even if it was made from other photos."
    )
    view: bool = switch(
        "Show the training in the browser, and afterwards the finished scene until Ctrl-C."
    )
    address: PageAddress = group(PageAddress)

    def run(self) -> Any:
        """The exit code is 130 after Ctrl-C."""
        from snowsplat.pipeline.make import make

        page = self.address.page(self.view)
        with page or nullcontext():
            try:
                with TerminalObserver() as observer:
                    result = make(
                        self.inputs,
                        self.output,
                        self.options,
                        overwrite=self.overwrite,
                        observer=observer,
                        page=page,
                    )
            except KeyboardInterrupt as stopped:
                print(with_flags(str(stopped) or "stopped"))
                again = {k: v for k, v in self.given.items() if k not in ("overwrite", "json")}
                print_message(
                    "resume with: {command_line}",
                    command_line=command_line("make", words(Make, again)),
                )
                return Exit(130)
            print_summary(result)
            print("\n" + str(see_and_share(result.project.path)), flush=True)
            if page is not None:
                self._show(result, page)
        return result.as_json()

    def _show(self, made: MakeResult, page: LivePage) -> None:
        """Show the scene until Ctrl-C, on the page of the training if there was one."""
        from snowsplat.formats import read_gaussians

        if page.training is not None:
            with suppress(KeyboardInterrupt):  # Ctrl-C may arrive before the scene is shown
                gaussians = read_gaussians(made.scene)
                print_message("the scene is shown at {url} until Ctrl-C", url=page.url)
                page.show_result(gaussians.to(self.options.compute.apply()))
            return
        from snowsplat.pipeline.watch import watch

        with WatchObserver() as observer:
            watch(made.training.path, page, compute=self.options.compute, observer=observer)


def print_summary(made: MakeResult) -> None:
    """Print the files of a finished scene, its quality, and the verdict."""
    size = format_bytes(made.scene.stat().st_size)
    print()
    print_message("The scene, for any viewer:  {scene} ({size})", scene=made.scene, size=size)
    if made.dataset_report:
        print_message("Report on camera poses:     {report}", report=made.dataset_report)
    else:
        print_message("Camera poses:               those of {path}", path=made.dataset.path)
    print_message("Report on the training:     {report}", report=made.training.report)
    for line in _quality(made):
        print(line)
    print_message("Time:                       {time}", time=duration(made.seconds))
    if made.verdict is not None:
        print("\n" + "\n".join(made.verdict.lines(message("the scene"))))
    sys.stdout.flush()


def _quality(made: MakeResult) -> list[Message]:
    """The lines about the held-out photos; none if there are none."""
    known = made.figures
    if known.psnr is None:
        return []
    values = {"psnr": known.psnr, "aligned": known.psnr_aligned, "ssim": known.ssim}
    figures = message(
        "PSNR {psnr:.2f} dB, colour-aligned PSNR {aligned:.2f} dB, SSIM {ssim:.3f}", **values
    )
    if known.exposures:  # the exposures of the held-out photos are others
        figures = message(
            "PSNR {psnr:.2f} at mean exposure, colour-aligned {aligned:.2f} dB, SSIM {ssim:.3f}",
            **values,
        )
    lines = [
        message("Rendered test views:        {folder}", folder=made.renders),
        message(" and held-out photos:       {folder}", folder=made.photos),
        message(
            "Quality of these views:     {figures} ({photos} of {size})",
            figures=figures,
            photos=plural("{n} photo", "{n} photos", n=known.views),
            size=known.size,
        ),
    ]
    if made.last_part.steps:
        used = photos_of_last_part(made.last_part.photos, made.last_part.left_out)
        lines.append(
            message(
                "                            before the last part, which has used {photos}",
                photos=used,
            )
        )
    return lines
