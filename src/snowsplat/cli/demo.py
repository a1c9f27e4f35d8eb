"""`snowsplat demo`: the complete pipeline on photos of a synthetic scene."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.cli.command import Command, Exit, print_message, see_and_share
from snowsplat.cli.make import print_summary
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.view import View
from snowsplat.util.flags import command_line, with_flags, words
from snowsplat.util.messages import message
from snowsplat.util.settings import setting, switch

if TYPE_CHECKING:
    from snowsplat.synthetic.compare_poses import PoseErrors


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """Try snowsplat: make a scene from rendered photos of a synthetic scene.

    Examples:
      snowsplat demo
      snowsplat demo -o out/demo --open

    Notes:
      The photos are ray traced, with lens distortion and noise. The scene is
      made from the photos alone, as by snowsplat make. At the end, the estimated
      camera poses are compared with the true ones; the exit code is 1 if the
      difference is large. This takes about three minutes. If the command is
      interrupted, run it again to resume.
    """

    output: Path = setting(
        Path("snowsplat_demo"),
        "Output folder. It is created if it does not exist.",
        "./snowsplat_demo",
        metavar="OUT",
        aliases=("-o",),
    )
    open: bool = switch(
        "Show the finished scene in the browser until Ctrl-C, as snowsplat view does."
    )

    def run(self) -> Exit | None:
        """The exit code is 1 if the poses are wrong, and 130 after Ctrl-C."""
        from snowsplat.pipeline.demo import demo

        try:
            with TerminalObserver() as observer:
                result = demo(self.output, observer=observer)
        except KeyboardInterrupt as stopped:
            print(with_flags(str(stopped) or "stopped"))
            print_message(
                "resume with: {command_line}",
                command_line=command_line("demo", words(Demo, self.given)),
            )
            return Exit(130)
        print_summary(result.made)
        _print_errors(result.errors)
        if not result.accurate:
            wrong = message(
                "snowsplat: the camera poses are wrong; repeat the demo in a new folder"
            )
            print(wrong, file=sys.stderr)
            return Exit(1)
        scene = result.made.project.path
        if not self.open:
            print_message("\n{see_and_share}", see_and_share=see_and_share(scene))
            print_message("with your own photos: snowsplat make PHOTOS")
            return None
        View(path=scene).run()
        return None


def _print_errors(errors: PoseErrors) -> None:
    from snowsplat.pipeline.demo import MAX_DEGREES, MAX_SHARE

    degrees, shares = errors.rotations, errors.centres
    found, total = len(errors.names), len(errors.names) + len(errors.missing)
    print_message(
        "\nEstimated poses compared with the true ones ({found} of {total} "
        "photos)\n                            median     worst      limit\n  "
        "rotation                  {median:.3f}\xb0     {max:.3f}\xb0     {max_degrees}\xb0\n  "
        "position, of the extent   {median2:.3%}     {max2:.3%}     {max_share:.1%}",
        found=found,
        total=total,
        median=degrees.median(),
        max=degrees.max(),
        max_degrees=MAX_DEGREES,
        median2=shares.median(),
        max2=shares.max(),
        max_share=MAX_SHARE,
    )
