"""`fit_image`: a photo as 2D Gaussians. `decode_image`: the image in a compact file."""

from __future__ import annotations

import base64
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup
from PIL import Image
from torch import Tensor

from snowsplat.data.photos.decode import ImageSource, load_image, read_header
from snowsplat.evaluation.metrics import compare
from snowsplat.extras.image.compact_file import read_compact, write_compact, write_svg
from snowsplat.extras.image.fit import COLORS, LOG_SIGMAS, OPACITY_LOGIT, Fitter, ImageGaussians
from snowsplat.extras.image.options import FitOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.image_files import write_png
from snowsplat.scene.render import to_8bit
from snowsplat.training.core.trainer import Progress
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util import charts
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_output, new_entries, write_json, write_text
from snowsplat.util.html import picture, render_page
from snowsplat.util.image_size import scaled_size
from snowsplat.util.machine import processor_name, system_name
from snowsplat.util.messages import Message, message
from snowsplat.util.process import single_threaded
from snowsplat.util.settings import Setting, checked

#: The files that `fit_image` writes to the output folder, and what they contain.
FILES = {
    "image.png": message("the image that the Gaussians approximate the photo with"),
    "image.gimg": message("the Gaussians, quantised: a compact file"),
    "image.svg": message("an ellipse with a gradient for each Gaussian"),
    "forming.mp4": message("a video of the fit"),
    "metrics.json": message("PSNR and SSIM, and their course"),
    "report.html": message("this page"),
}
_SIZE = Setting(least=8, most=8192)  # pixels along the longer side
_VIDEO_SECONDS, _VIDEO_FPS = 5, 24
_VIDEO_HOLD = 24  # frames in which the result is shown at the end
_VIDEO_LEAST_SIDE = 480  # pixels along the longer side
# The page shows images with at least this many pixels along the longer side: the Gaussians are
# rendered at a larger size, and the photo is enlarged.
_LEAST_SIDE = 512
# In the picture of the Gaussians, σ is multiplied by this factor, so that most do not overlap.
_SHRUNK = 0.5


@dataclass(frozen=True)
class ImageResult:
    """A fitted image.

    Attributes:
        output: the output folder.
        moments: the course of the fit. The last moment is the result.
        file_psnr: PSNR of the image in the compact file, in dB.
        file_bytes: size of the compact file.
        bits_per_pixel: the same, per pixel of the image.
    """

    output: Path
    moments: list[Moment] = field(repr=False)
    file_psnr: float
    file_bytes: int
    bits_per_pixel: float


def fit_image(
    photo: Path | str,
    output: Path | str,
    options: FitOptions | None = None,
    *,
    size: int = 512,
    threads: int | None = None,
    overwrite: bool = False,
    observer: Observer = SILENT,
) -> ImageResult:
    """Approximate a photo by 2D Gaussians, and write the files of `FILES`.

    Additive Gaussians have no SVG file. The computation runs on the CPU.

    Args:
        photo: the image file.
        output: the output folder. It is created if it does not exist.
        options: number of Gaussians, blending, steps and seed.
        size: pixels along the longer side, to which a larger photo is scaled down.
        threads: number of CPU threads; None: all cores. The result does not depend on it.
        overwrite: replace the files of an earlier fit in ``output``.

    Returns:
        PSNR, SSIM, seconds and bytes.

    Raises:
        UserError: the photo is missing or damaged, a setting is out of range, or ``output``
            contains an earlier fit or is a file.
        OSError: a file cannot be written.
    """
    options, photo, output = options or FitOptions(), Path(photo), Path(output)
    checked("size", size, int, _SIZE)
    check_output(output, lambda _: True)
    if (output / "metrics.json").exists() and not overwrite:
        raise UserError(
            "{output}: contains an earlier fit; use `overwrite` to replace it", output=output
        )
    target = load_photo(photo, size)
    Compute("cpu", threads).apply()
    output.mkdir(parents=True, exist_ok=True)

    names = sorted(FILES, key="metrics.json".__eq__)  # which shows that there is a fit
    with single_threaded(), new_entries(output, names) as new:
        fitter = Fitter(target, options)
        moments = _run(fitter, target, new / "forming.mp4", observer)
        gaussians = fitter.gaussians
        write_png(new / "image.png", to_8bit(gaussians.render()))
        stored = write_compact(new / "image.gimg", gaussians)
        file_psnr = compare(stored.render(), target).psnr
        files = dict(FILES)
        if gaussians.blending == "front-to-back":
            write_svg(new / "image.svg", gaussians)
        else:
            del files["image.svg"]
        file_bytes = (new / "image.gimg").stat().st_size
        width, height = gaussians.width, gaussians.height
        bits = 8 * file_bytes / (width * height)
        write_image_report(
            new / "report.html",
            Fitted(
                name=photo.stem,
                photo=(target * 255).round().byte(),
                gaussians=gaussians,
                moments=moments,
                compact=(file_psnr, file_bytes, bits),
                files=files,
                video=new / "forming.mp4",
            ),
        )
        result = ImageResult(output, moments, file_psnr, file_bytes, bits)
        write_json(new / "metrics.json", _metrics(result, options, (width, height)))
    return result


def decode_image(
    compact: Path | str, target: Path | str, size: int | None = None
) -> tuple[int, int]:
    """Render the Gaussians of a compact file to a PNG file.

    Args:
        compact: a file that `fit_image` has written.
        target: the PNG file.
        size: pixels along the longer side; default: as fitted. Gaussians have no pixels, so the
            image may be larger than the photo.

    Returns:
        Width and height of the image in pixels.

    Raises:
        UserError: the file is missing or damaged, or ``size`` is out of range.
        OSError: ``target`` cannot be written.
    """
    gaussians = read_compact(Path(compact))
    scale = 1.0
    if size is not None:
        checked("size", size, int, _SIZE)
        scale = size / max(gaussians.width, gaussians.height)
    image = gaussians.render(scale)
    write_png(Path(target), to_8bit(image))
    return image.shape[1], image.shape[0]


def load_photo(photo: Path, size: int) -> Tensor:
    """A photo, scaled down so that its longer side has at most `size` pixels.

    Returns (H, W, 3) float32 in 0..1. A transparent photo is composited over white.
    Raises: UserError: the file is missing or damaged.
    """
    header = read_header(photo)
    width, height = header.width, header.height
    if header.sideways:
        width, height = height, width
    width, height = scaled_size(width, height, size)
    planes = load_image(ImageSource(photo, width, height, apply_orientation=True), (1.0, 1.0, 1.0))
    return planes.float().div(255).permute(1, 2, 0)


def _run(fitter: Fitter, target: Tensor, video: Path, observer: Observer) -> list[Moment]:
    """Take all steps; record the moments and the video."""
    steps = fitter.options.steps
    recorded = set(recorded_steps(steps, _VIDEO_SECONDS * _VIDEO_FPS))
    height, width = target.shape[:2]
    scale = max(1, math.ceil(_VIDEO_LEAST_SIDE / max(width, height)))
    frame_width, frame_height = (2 * max(1, side * scale // 2) for side in (width, height))
    moments: list[Moment] = []
    seconds = 0.0
    with (
        observer.stepping(0, steps),
        video_writer(video, frame_width, frame_height, _VIDEO_FPS) as add_frame,
    ):
        while not fitter.finished:
            start = time.perf_counter()
            fitter.step()
            seconds += time.perf_counter() - start
            step, gaussians = fitter.steps_done, fitter.gaussian_count
            observer.step(Progress(step, fitter.mse, gaussians, steps, downscale=1))
            if step in recorded:
                model = fitter.gaussians
                metrics = compare(model.render(), target)
                moments.append(Moment(step, seconds, gaussians, metrics.psnr, metrics.ssim))
                frame = _frame(model, scale, frame_width, frame_height)
                add_frame(frame)
        for _ in range(_VIDEO_HOLD):
            add_frame(frame)
    return moments


def _frame(gaussians: ImageGaussians, scale: int, width: int, height: int) -> np.ndarray:
    """(height, width, 3) uint8: the image, `scale` times as large, cut to an even size."""
    pixels = to_8bit(gaussians.render(scale))[:height, :width]
    missing = height - pixels.shape[0], width - pixels.shape[1]  # of an image of 1 pixel
    return np.pad(pixels, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")


def _metrics(result: ImageResult, options: FitOptions, size: tuple[int, int]) -> dict[str, Any]:
    """The content of metrics.json."""
    end = result.moments[-1]
    return {
        "width": size[0],
        "height": size[1],
        "psnr": end.psnr,
        "ssim": end.ssim,
        "seconds": end.seconds,
        "compact_file": {
            "psnr": result.file_psnr,
            "bytes": result.file_bytes,
            "bits_per_pixel": result.bits_per_pixel,
        },
        "settings": asdict(options),
        "course": [asdict(moment) for moment in result.moments],
    }


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
