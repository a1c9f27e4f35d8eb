"""`snowsplat image`: a photo as 2D Gaussians."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.extras.image.options import FitOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import group, needed, setting

_COMPACT = ".gimg"
_NEEDED = message("image needs a photo and an output folder: snowsplat image PHOTO -o OUT")


@dataclass(frozen=True, kw_only=True)
class Image(JsonCommand):
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

    photo: Path = needed(
        _NEEDED,
        "PHOTO|FILE.gimg",
        "The photo, or a compact file of Gaussians.",
        argument=True,
    )
    output: Path = needed(
        _NEEDED,
        "OUT",
        "The output folder. It is created if it does not exist. For a compact file: the PNG file.",
        "-o",
    )
    options: FitOptions = group(FitOptions)
    size: int | None = setting(
        None,
        "Pixels along the longer side. A larger photo is scaled down.",
        "512; of a file: as fitted",
        metavar="PIXELS",
    )
    compute: Compute = group(Compute, only=("threads",))
    overwrite: bool = common.overwrite("Replace an earlier fit in OUT.")
    quiet: bool = common.quiet()

    def run(self) -> dict[str, Any] | None:
        if self.photo.suffix.lower() == _COMPACT:
            self._decode(self.photo, self.output)
            return None
        from snowsplat.extras.image.fit_image import fit_image

        with TerminalObserver(self.quiet) as observer:
            result = fit_image(
                self.photo,
                self.output,
                self.options,
                size=512 if self.size is None else self.size,
                threads=self.compute.threads,
                overwrite=self.overwrite,
                observer=observer,
            )
        end = result.moments[-1]
        print_message(
            "{output}: {gaussians:,} Gaussians, PSNR {psnr:.2f} dB, SSIM {ssim:.4f}, "
            "{step:,} steps in {seconds}",
            output=result.output,
            gaussians=end.gaussians,
            psnr=end.psnr,
            ssim=end.ssim,
            step=end.step,
            seconds=duration(end.seconds),
        )
        print_message(
            "{output}: {file_bytes}, {bits_per_pixel:.2f} bits per pixel, PSNR {file_psnr:.2f} dB",
            output=result.output / "image.gimg",
            file_bytes=format_bytes(result.file_bytes),
            bits_per_pixel=result.bits_per_pixel,
            file_psnr=result.file_psnr,
        )
        print_message("to see it: open {output} in a browser", output=result.output / "report.html")
        return {
            "output": result.output,
            "gaussians": end.gaussians,
            "psnr": end.psnr,
            "ssim": end.ssim,
            "steps": end.step,
            **{name: getattr(result, name) for name in ("file_psnr", "file_bytes")},
            "bits_per_pixel": result.bits_per_pixel,
        }

    def _decode(self, compact: Path, target: Path) -> None:
        if target.suffix.lower() != ".png":
            raise UserError(
                "{target}: the image of a compact file is written as PNG; use -o FILE.png",
                target=target,
            )
        from snowsplat.extras.image.fit_image import decode_image

        width, height = decode_image(compact, target, self.size)
        print_message(
            "{target}: {width} × {height} pixels", target=target, width=width, height=height
        )
