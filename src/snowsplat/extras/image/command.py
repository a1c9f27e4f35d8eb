"""`snowsplat image`: a photo as 2D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from snowsplat.cli.flags import Quiet, Threads, flag, switch
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

_COMPACT = ".gimg"


@dataclass
class Image(Reports):
    """Approximate a photo by 2D Gaussians, or render such an approximation.

    Examples:
      snowsplat image cat.jpg -o cat
      snowsplat image cat.jpg -o cat -n 10000 --size 1024
      snowsplat image cat/image.gimg -o large.png --size 2048

    Notes:
      OUT contains the image (image.png), an SVG of ellipses with gradients, a
      compact file (image.gimg), a video of the fit, and report.html.
      A compact file in place of PHOTO is rendered to the PNG file OUT.
    """

    photo: Annotated[Path | None, tyro.conf.Positional, flag("PHOTO|FILE.gimg")] = None
    """The photo, or a compact file of Gaussians."""
    output: Annotated[Path | None, flag("OUT", "-o")] = None
    """The output folder. It is created if it does not exist. For a compact file: the PNG file."""
    gaussians: Annotated[int, flag("N", "-n", default="1000")] = 1000
    """Number of Gaussians."""
    blending: Annotated[
        Literal["front-to-back", "additive"],
        flag("{front-to-back,additive}", default="front-to-back"),
    ] = "front-to-back"
    """front-to-back: opaque to transparent ellipses, the first one in front; additive: the sum of
    the Gaussians, without SVG."""
    steps: Annotated[int, flag("N", default="3000")] = 3000
    """Number of steps of the optimiser. More steps give a better image."""
    size: Annotated[int | None, flag("PIXELS", default="512; of a file: as fitted")] = None
    """Pixels along the longer side. A larger photo is scaled down."""
    seed: Annotated[int, flag("N", default="0")] = 0
    """Seed of the random positions of the Gaussians."""
    threads: Threads = None
    overwrite: Annotated[bool, switch()] = False
    """Replace an earlier fit in OUT."""
    quiet: Quiet = False
    json: JsonFlag = False

    def run(self) -> int:
        if self.photo is None or self.output is None:
            raise UserError(
                "image needs a photo and an output folder: snowsplat image PHOTO -o OUT"
            )
        if self.photo.suffix.lower() == _COMPACT:
            return self._decode(self.photo, self.output)
        from snowsplat.extras.image.fit import FitOptions
        from snowsplat.extras.image.fit_image import fit_image

        options = FitOptions(
            gaussians=self.gaussians, blending=self.blending, steps=self.steps, seed=self.seed
        )
        with TerminalObserver(self.quiet) as observer:
            result = fit_image(
                self.photo,
                self.output,
                options,
                size=512 if self.size is None else self.size,
                threads=self.threads,
                overwrite=self.overwrite,
                observer=observer,
            )
        end = result.moments[-1]
        self.report = {
            "output": result.output,
            "gaussians": end.gaussians,
            "psnr": end.psnr,
            "ssim": end.ssim,
            "steps": end.step,
            **{name: getattr(result, name) for name in ("file_psnr", "file_bytes")},
            "bits_per_pixel": result.bits_per_pixel,
        }
        print(
            message(
                "{output}: {gaussians:,} Gaussians, PSNR {psnr:.2f} dB, SSIM {ssim:.4f}, "
                "{step:,} steps in {seconds}",
                output=result.output,
                gaussians=end.gaussians,
                psnr=end.psnr,
                ssim=end.ssim,
                step=end.step,
                seconds=duration(end.seconds),
            )
        )
        print(
            message(
                "{output}: {file_bytes}, {bits_per_pixel:.2f} bits per pixel, PSNR "
                "{file_psnr:.2f} dB",
                output=result.output / "image.gimg",
                file_bytes=format_bytes(result.file_bytes),
                bits_per_pixel=result.bits_per_pixel,
                file_psnr=result.file_psnr,
            )
        )
        print(
            message("to see it: open {output} in a browser", output=result.output / "report.html")
        )
        return 0

    def _decode(self, compact: Path, target: Path) -> int:
        if target.suffix.lower() != ".png":
            raise UserError(
                "{target}: the image of a compact file is written as PNG; use -o FILE.png",
                target=target,
            )
        from snowsplat.extras.image.fit_image import decode_image

        width, height = decode_image(compact, target, self.size)
        print(
            message(
                "{target}: {width} × {height} pixels", target=target, width=width, height=height
            )
        )
        return 0
