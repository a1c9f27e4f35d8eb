"""report.html: a fitted image, its Gaussians, and the course of the fit, on one page."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from markupsafe import Markup
from PIL import Image
from torch import Tensor

from snowsplat.extras.image.model import COLORS, LOG_SIGMAS, OPACITY_LOGIT, ImageGaussians
from snowsplat.scene.render import to_8bit
from snowsplat.util import charts
from snowsplat.util.files import write_text
from snowsplat.util.html import picture, render_page
from snowsplat.util.machine import processor_name, system_name
from snowsplat.util.messages import Message, message

# The page shows images with at least this many pixels along the longer side: the Gaussians are
# rendered at a larger size, and the photo is enlarged.
_LEAST_SIDE = 512
# In the picture of the Gaussians, σ is multiplied by this factor, so that most do not overlap.
_SHRUNK = 0.5


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
    files: dict[str, Message]  # names and descriptions of the files beside the page
    video: Path  # the video of the fit


def write_image_report(path: Path, fitted: Fitted) -> None:
    """Write the page, atomically. Raises OSError if it cannot be written."""
    video = base64.b64encode(fitted.video.read_bytes()).decode("ascii")
    values = {
        "title": f"{fitted.name} – Gaussians",
        "end": fitted.moments[-1],
        "pictures": _pictures(fitted),
        "video": Markup("data:video/mp4;base64,") + video,
        "curves": _curves(fitted.moments),
        "processor": processor_name(),
        "system": system_name(),
    }
    page = render_page("extras/image/image_report.html.j2", **vars(fitted) | values)
    write_text(path, page)


def shrink(gaussians: ImageGaussians, image: Tensor) -> ImageGaussians:
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
def _pictures(fitted: Fitted) -> list[tuple[str, Markup, Message]]:
    """A CSS class, a picture and its caption each."""
    gaussians, photo = fitted.gaussians, Image.fromarray(fitted.photo.numpy())
    scale = max(1, -(-_LEAST_SIDE // max(photo.size)))
    image = gaussians.render().clamp(0, 1)
    large, ellipses = gaussians.render(scale), shrink(gaussians, image).render(scale)
    return [
        ("photo", picture(photo, "photo", 95), message("The photo")),
        ("", picture(_pixels(large), "the Gaussians", 92), message("The Gaussians")),
        (
            "",
            picture(_pixels(ellipses), "ellipses", 92),
            message("The Gaussians at half their size"),
        ),
    ]


def _pixels(image: Tensor) -> Image.Image:
    """(H, W, 3) in 0..1 as an 8-bit image."""
    return Image.fromarray(to_8bit(image))


def _curves(moments: list[Moment]) -> list[tuple[Message, Markup]]:
    """Captions and drawings of the course of the fit."""
    curves = {
        message("PSNR, dB"): [(m.seconds, m.psnr) for m in moments],
        message("SSIM"): [(m.seconds, m.ssim) for m in moments],
        message("Gaussians"): [(m.seconds, float(m.gaussians)) for m in moments],
    }
    seconds = message("seconds")
    return [
        (
            name,
            charts.chart(points, x_label=seconds, y_label=name, from_zero=name.key == "Gaussians"),
        )
        for name, points in curves.items()
    ]
