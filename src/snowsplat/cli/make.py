"""`snowsplat make`: photos or a video become a scene, in one command."""

from __future__ import annotations

import shlex
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from snowsplat.cli.flags import Marker, Threads, flag, marker_side, switch, with_flags
from snowsplat.cli.next_steps import see_and_share
from snowsplat.cli.observer import TerminalObserver, WatchObserver
from snowsplat.cli.page_flags import AllowHost, page_at
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.pipeline.stage_lines import photos_of_last_part
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.pipeline.make import MakeResult
    from snowsplat.pipeline.run.live_page import LivePage

# The flags that the command for resuming repeats, in this order.
_RESUMED_FLAGS = (
    "output",
    "quality",
    "minutes",
    "hold_out",
    "title",
    "exposure",
    "marker",
    "threads",
    "device",
    "memory",
    "port",
    "host",
)


@dataclass
class Make(Reports):
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

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("INPUT [INPUT ...]")] = ()
    """One or more photos (JPEG, PNG, WebP, TIFF, HEIC), folders of photos, or videos. The camera
    poses of a dataset are used, if its folder is the only input and they are plausible."""
    output: Annotated[Path | None, flag("OUT", "-o", default="./INPUT_scene")] = None
    """Output folder. It is created if it does not exist."""
    quality: Annotated[
        Literal["draft", "normal", "best"] | None,
        flag("{draft,normal,best}", default="normal; with --minutes, chosen for this time"),
    ] = None
    """draft: a quick preview; best: takes several times as long as normal. With --minutes, the
    quality determines only the effort to estimate the camera poses; the training uses the remaining
    time."""
    config: Annotated[Path | None, flag("FILE")] = None
    """A JSON or TOML file with values of these flags. Flags have priority."""
    minutes: Annotated[float | None, flag("F", default="none")] = None
    """Finish within this time. If there are too many photos for this time, some of them are used,
    evenly spread by name. If an earlier run was interrupted, the time of its finished stages is not
    counted, and its training resumes with the time that remained."""
    hold_out: Annotated[str | None, flag("{none,N}", default="8")] = None
    """Hold out every N-th photo until the scene is evaluated. Then the scene is trained on all
    photos for a moment; the printed PSNR is that of the scene before."""
    title: Annotated[str | None, flag("TEXT", default="the name of the input")] = None
    """The name of the scene in its report and on its pages."""
    exposure: Annotated[
        Literal["auto", "on", "off"] | None, flag("{auto,on,off}", default="auto")
    ] = None
    """Whether to learn a gain for each photo and colour channel, for photos with different
    exposures or white balances. auto: if the photos differ by at least 0.05 EV."""
    marker: Marker = None
    threads: Threads = None
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """Device to train on."""
    memory: Annotated[str | None, flag("BYTES", default="no limit")] = None
    """Memory limit of the training, for example 4GB. See snowsplat train --help."""
    overwrite: Annotated[bool, switch()] = False
    """Replace the scene in OUT even if it was made from other photos."""
    view: Annotated[bool, switch()] = False
    """Show the training in the browser, and afterwards the finished scene until Ctrl-C."""
    port: Annotated[int | None, flag("N", default="8080, or the next free one")] = None
    """Port of the page. Its URL, which is printed, contains a secret token."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer only")] = None
    """Address to listen on. 0.0.0.0 accepts connections from the network."""
    allow_host: AllowHost = ()
    json: JsonFlag = False

    def run(self) -> int:
        """Returns the exit code: 0, or 130 after Ctrl-C."""
        from snowsplat.pipeline.compute import Compute
        from snowsplat.pipeline.make import MakeOptions, make

        options = MakeOptions(
            quality=self.quality,
            minutes=self.minutes,
            memory=self.memory,
            title=self.title,
            exposure=self.exposure or "auto",
            marker=marker_side(self.marker),
            compute=Compute(self.device, self.threads),
            **({} if self.hold_out is None else {"hold_out": _hold_out(self.hold_out)}),
        )
        page = page_at(self.port, self.host, self.allow_host, self.view)
        with page or nullcontext():
            try:
                with TerminalObserver() as observer:
                    result = make(
                        self.inputs,
                        self.output,
                        options,
                        overwrite=self.overwrite,
                        observer=observer,
                        page=page,
                    )
            except KeyboardInterrupt as stopped:
                print(with_flags(str(stopped) or "stopped"))
                return self._stopped()
            self.report = {**vars(result), "folder": result.folder.path}
            print_summary(result)
            print("\n" + see_and_share(result.folder.path.parent), flush=True)
            if page is not None:
                self._show(result, page)
        return 0

    def _stopped(self) -> int:
        words = ["snowsplat", "make", *map(str, self.inputs)]
        for name in _RESUMED_FLAGS:
            value = getattr(self, name)
            words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
        words += ["--view"] if self.view else []
        print(message("resume with: {words}", words=shlex.join(words)))
        return 130

    def _show(self, made: MakeResult, page: LivePage) -> None:
        """Show the scene until Ctrl-C, on the page of the training if there was one."""
        from snowsplat.formats import read_gaussians
        from snowsplat.pipeline.compute import Compute

        if page.has_trained:
            with suppress(KeyboardInterrupt):  # Ctrl-C may arrive before the scene is shown
                gaussians = read_gaussians(made.scene)
                print(message("the scene is shown at {url} until Ctrl-C", url=page.url), flush=True)
                page.show_result(gaussians.to(Compute(self.device, self.threads).apply()))
            return
        from snowsplat.pipeline.watch import watch

        with WatchObserver() as observer:
            watch(
                made.folder.path,
                page,
                compute=Compute(self.device, self.threads),
                observer=observer,
            )


def _hold_out(text: str) -> int | None:
    """Raises UserError: the text is neither a number from 2 on nor "none"."""
    if text == "none":
        return None
    if not text.isdecimal() or int(text) < 2:
        raise UserError("--hold-out: {text!r} is not valid; use 2 or more, or none", text=text)
    return int(text)


def print_summary(made: MakeResult) -> None:
    """Print the files of a finished scene, its quality, and the verdict."""
    poses = made.dataset_report or f"those of {made.dataset} are used"
    print(
        message(
            "\nThe scene, for any viewer:  {scene} ({st_size})\n{what:27} {poses}\nReport on the "
            "training:     {report}\n{quality}Time:                       {seconds}",
            scene=made.scene,
            st_size=format_bytes(made.scene.stat().st_size),
            what="Report on camera poses:" if made.dataset_report else "Camera poses:",
            poses=poses,
            report=made.folder.report,
            quality=_quality(made),
            seconds=duration(made.seconds),
        )
    )
    if made.verdict is not None:
        print("\n" + "\n".join(made.verdict.lines(message("the scene"))))
    sys.stdout.flush()


def _quality(made: MakeResult) -> str:
    """The lines about the held-out photos; "" if there are none."""
    if made.psnr is None:
        return ""
    aligned = f"colour-aligned PSNR {made.psnr_aligned:.2f} dB"
    figures = f"PSNR {made.psnr:.2f} dB, {aligned}, SSIM {made.ssim:.3f}"
    if made.exposures:  # the scene has the mean exposure of the photos, not that of each of them
        figures = f"{aligned} (gains of exposure are learnt), SSIM {made.ssim:.3f}"
    photos = "1 photo" if made.views == 1 else f"{made.views} photos"
    lines = [
        f"Rendered test views:        {made.renders}",
        f" and held-out photos:       {made.photos}",
        f"Quality of these views:     {figures} ({photos} of {made.size})",
    ]
    if made.all_photos:
        lines.append(
            "                            before the last part, which has used "
            + photos_of_last_part(made.all_photos, made.left_out)
        )
    return "\n".join(lines) + "\n"
