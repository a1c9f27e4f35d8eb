"""`snowsplat anamorph`: Gaussians that show another picture from each side."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.extras.anamorph.options import AnamorphOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.messages import message
from snowsplat.util.settings import argument, group, needed


@dataclass(frozen=True, kw_only=True)
class Anamorph(JsonCommand):
    """Make a scene that shows another picture from each side.

    Examples:
      snowsplat anamorph cat.jpg dog.jpg -o pets
      snowsplat anamorph cat.jpg dog.jpg bird.jpg -o pets --shape solid
      snowsplat mesh pets -o pets.ply --gaussians-only

    Notes:
      The first picture is seen from the front, the second from the right, the
      third from above. OUT is an output folder as that of train: view, render,
      convert and mesh read it. OUT/anamorph.html shows the scene in a browser.
    """

    pictures: tuple[Path, ...] = argument(
        (), "PICTURE PICTURE [PICTURE]", "Two or three pictures; their middle squares are used."
    )
    output: Path = needed(
        message("anamorph needs pictures and an output folder: snowsplat anamorph A B -o OUT"),
        "OUT",
        "The output folder. It is created if it does not exist.",
        "-o",
    )
    options: AnamorphOptions = group(AnamorphOptions)
    compute: Compute = group(Compute, only=("threads",))
    overwrite: bool = common.overwrite("Replace an earlier scene in OUT.")
    quiet: bool = common.quiet()

    def run(self) -> Any:
        from snowsplat.extras.anamorph.make_anamorph import make_anamorph

        with TerminalObserver(self.quiet) as observer:
            result = make_anamorph(
                self.pictures,
                self.output,
                self.options,
                threads=self.compute.threads,
                overwrite=self.overwrite,
                observer=observer,
            )
        print_message(
            "{scene}: {gaussians:,} Gaussians; PSNR of the pictures {psnr} dB",
            scene=result.scene,
            gaussians=result.gaussians,
            psnr=", ".join(f"{value:.1f}" for value in result.psnr),
        )
        print_message(
            "to see it: open {page} in a browser; to share it: send this file", page=result.page
        )
        if self.options.shape == "solid":
            mesh = "mesh", self.output, "-o", self.output / "mesh.ply", "--gaussians-only"
            print(next_step(message("to print it"), *mesh))
        return result
