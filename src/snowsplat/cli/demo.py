"""`snowsplat demo`: the complete pipeline on photos of a synthetic scene."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from snowsplat.cli.flags import flag, switch, with_flags
from snowsplat.cli.make import print_summary
from snowsplat.cli.next_steps import see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.view import View
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.synthetic.compare_poses import PoseErrors


@dataclass
class Demo:
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

    output: Annotated[Path, flag("OUT", "-o", default="./snowsplat_demo")] = Path("snowsplat_demo")
    """Output folder. It is created if it does not exist."""
    open: Annotated[bool, switch()] = False
    """Show the finished scene in the browser until Ctrl-C, as snowsplat view does."""

    def run(self) -> int:
        """Returns the exit code: 0; 1 if the poses are wrong; 130 after Ctrl-C."""
        from snowsplat.pipeline.demo import demo

        try:
            with TerminalObserver() as observer:
                result = demo(self.output, observer=observer)
        except KeyboardInterrupt as stopped:
            print(with_flags(str(stopped) or "stopped"))
            words = ["snowsplat", "demo", "-o", str(self.output)] + ["--open"] * self.open
            print(message("resume with: {words}", words=shlex.join(words)))
            return 130
        print_summary(result.made)
        _print_errors(result.errors)
        if not result.accurate:
            print(
                "snowsplat: the camera poses are wrong; repeat the demo in a new folder while no "
                "other programs run",
                file=sys.stderr,
            )
            return 1
        scene = result.made.folder.path.parent
        if not self.open:
            print(message("\n{see_and_share}", see_and_share=see_and_share(scene)))
            print("with your own photos: snowsplat make PHOTOS")
            return 0
        return View(scene).run()


def _print_errors(errors: PoseErrors) -> None:
    from snowsplat.pipeline.demo import MAX_DEGREES, MAX_SHARE

    degrees, shares = errors.rotations, errors.centres
    found, total = len(errors.names), len(errors.names) + len(errors.missing)
    print(
        message(
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
        ),
        flush=True,
    )
