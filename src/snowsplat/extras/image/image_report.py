"""report.html: a fitted image, its Gaussians, and the course of the fit, on one page."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from snowsplat.extras.image.model import COLORS, LOG_SIGMAS, OPACITY_LOGIT, ImageGaussians
from snowsplat.pipeline.output.image_files import to_8bit
from snowsplat.util import charts
from snowsplat.util.duration import duration
from snowsplat.util.files import write_text
from snowsplat.util.html import cards, page, picture, table, text
from snowsplat.util.machine import processor_name, system_name

# The page shows images with at least this many pixels along the longer side: the Gaussians are
# rendered at a larger size, and the photo is enlarged.
_LEAST_SIDE = 512
# In the picture of the Gaussians, σ is multiplied by this factor, so that most do not overlap.
_SHRUNK = 0.5

_STYLE = (
    charts.STYLE
    + """
.pictures { display: grid; gap: 18px 16px;
  grid-template-columns: repeat(auto-fit, minmax(min(250px, 100%), 1fr)); }
.pictures img, .pictures video { display: block; width: 100%; height: auto; border-radius: 4px; }
.pictures .photo img { image-rendering: pixelated; }
td { font-variant-numeric: tabular-nums; }
"""
)


@dataclass(frozen=True)
class Moment:
    """The state of a fit after a step."""

    step: int
    seconds: float  # time spent in steps so far
    gaussians: int
    psnr: float  # dB
    ssim: float


def recorded_steps(steps: int, count: int) -> list[int]:
    """At most `count` steps from 1 to `steps`, at first close together.

    The k-th of them is proportional to k²: the image changes most in the first steps.
    """
    return sorted({max(1, round(steps * (k / count) ** 2)) for k in range(1, count + 1)})


@dataclass(frozen=True)
class Fitted:
    """The content of the page."""

    name: str  # of the photo
    photo: Tensor  # (H, W, 3) uint8
    gaussians: ImageGaussians  # the result of the fit
    moments: list[Moment]  # the course of the fit; the last one is the result
    compact: tuple[float, int, float]  # PSNR in dB, bytes and bits per pixel of the compact file
    files: dict[str, str]  # names and descriptions of the files beside the page
    video: Path  # the video of the fit


def write_image_report(path: Path, fitted: Fitted) -> None:
    """Write the page, atomically. Raises OSError if it cannot be written."""
    end = fitted.moments[-1]
    psnr, size, bits = fitted.compact
    gaussians = fitted.gaussians
    figures = [
        (f"{end.psnr:.2f} dB", "PSNR"),
        (f"{end.ssim:.4f}", "SSIM"),
        (f"{len(gaussians):,}", f"Gaussians, {gaussians.blending}"),
        (duration(end.seconds), f"for {end.step:,} steps"),
        (f"{bits:.2f}", f"bits per pixel: {size:,} bytes, {psnr:.2f} dB"),
    ]
    body = [
        f"<h1>{text(fitted.name)}</h1>\n<p>{gaussians.width} × {gaussians.height} pixels, "
        f"approximated by {len(gaussians):,} 2D Gaussians.</p>",
        cards(figures),
        _pictures(fitted),
        _curves(fitted.moments),
        "<h2>Files</h2>\n"
        + table([], [(text(name), text(about)) for name, about in fitted.files.items()]),
        "<h2>Machine</h2>\n"
        + table([], [("processor", text(processor_name())), ("system", text(system_name()))]),
    ]
    write_text(path, page(f"{fitted.name} – Gaussians", body, _STYLE))


def shrunk(gaussians: ImageGaussians, image: Tensor) -> ImageGaussians:
    """The Gaussians as small opaque ellipses, with the colours of the image (H, W, 3) there."""
    rows = gaussians.rows.clone()
    rows[:, LOG_SIGMAS] += torch.tensor(_SHRUNK).log()
    x = rows[:, 0].long().clamp(0, gaussians.width - 1)
    y = rows[:, 1].long().clamp(0, gaussians.height - 1)
    rows[:, COLORS] = image[y, x]
    if gaussians.blending == "additive":
        rows = torch.cat([rows, rows.new_zeros(len(rows), 1)], dim=1)
    rows[:, OPACITY_LOGIT] = 4.0
    black = torch.zeros_like(gaussians.background)
    return replace(gaussians, blending="front-to-back", rows=rows, background=black)


@torch.no_grad()
def _pictures(fitted: Fitted) -> str:
    gaussians, photo = fitted.gaussians, Image.fromarray(fitted.photo.numpy())
    scale = max(1, -(-_LEAST_SIDE // max(photo.size)))
    image = gaussians.render().clamp(0, 1)
    large, ellipses = gaussians.render(scale), shrunk(gaussians, image).render(scale)
    video = base64.b64encode(fitted.video.read_bytes()).decode("ascii")
    player = (
        '<video controls="" autoplay="" loop="" muted="" '
        f'src="data:video/mp4;base64,{video}"></video>'
    )
    figures = [
        ("photo", picture(photo, "photo", 95), "The photo"),
        ("", picture(_pixels(large), "the Gaussians", 92), "The Gaussians"),
        ("", picture(_pixels(ellipses), "ellipses", 92), "The Gaussians at half their size"),
        ("", player, "The fit; the video becomes faster towards the end"),
    ]
    inner = "\n".join(
        f'<figure class="{kind}">{html}<figcaption>{caption}</figcaption></figure>'
        for kind, html, caption in figures
    )
    return f'<div class="pictures">{inner}</div>'


def _pixels(image: Tensor) -> Image.Image:
    """(H, W, 3) in 0..1 as an 8-bit image."""
    return Image.fromarray(to_8bit(image))


def _curves(moments: list[Moment]) -> str:
    drawings = [
        ("PSNR, dB", [(m.seconds, m.psnr) for m in moments]),
        ("SSIM", [(m.seconds, m.ssim) for m in moments]),
        ("Gaussians", [(m.seconds, float(m.gaussians)) for m in moments]),
    ]
    figures = "\n".join(
        f"<figure><figcaption>{caption}</figcaption>"
        + charts.chart(points, x_label="seconds", y_label=caption, from_zero=caption == "Gaussians")
        + "</figure>"
        for caption, points in drawings
    )
    return f'<h2>The fit</h2>\n<div class="charts">{figures}</div>'
