"""report.html: how a training went and what came of it, on one page that needs nothing else."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat import charts, ops
from snowsplat.capture import Capture, ImageLoader, View
from snowsplat.evaluate import Evaluation, ViewMetrics, evaluate_views
from snowsplat.files import write_text
from snowsplat.gaussians import Gaussians
from snowsplat.history import History
from snowsplat.machine import memory_bytes, processor_name, system_name
from snowsplat.ops import native
from snowsplat.page import bar, cards, duration, page, picture, table, text
from snowsplat.process import single_threaded
from snowsplat.render import render

_WORST, _BEST = 3, 2  # views that are shown
_TRAINING_VIEWS = 8  # that are measured where none were held out
_PICTURE_SIDE = 360  # pixels of the longer side
_LISTED = 200  # views
_WHITE_ERROR = 0.25  # mean difference of the channels that is drawn white
_SMOOTHED = 40  # the loss is the mean of so many parts of the training

# From no error to `_WHITE_ERROR`: black, red, orange, white.
_ERROR_COLORS = np.array(
    [[0, 0, 0], [96, 14, 30], [200, 60, 20], [250, 170, 60], [255, 255, 255]], np.float32
)

_STYLE = (
    charts.STYLE
    + """
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(420px, 100%), 1fr));
  gap: 22px 28px; }
.views { display: flex; flex-wrap: wrap; gap: 18px 16px; }
.triple { display: flex; gap: 5px; }
.triple img { height: auto; max-height: 200px; width: auto; min-width: 0; flex: 0 1 auto;
  object-fit: contain; border-radius: 3px; }
td { font-variant-numeric: tabular-nums; }
"""
)


@dataclass(frozen=True)
class Trained:
    """What the page tells about.

    Attributes:
        name: of the scene.
        step: the last one.
        background: of the views, in 0..1.
        evaluation: of the held-out views; without any, some training views are measured.
        settings: by name: what was set, as JSON values.
        peak_bytes: the most memory that was held; 0 if that is not known.
    """

    name: str
    capture: Capture
    gaussians: Gaussians
    step: int
    background: tuple[float, float, float]
    history: History
    evaluation: Evaluation | None
    settings: dict[str, Any]
    peak_bytes: int = 0


def write_training_report(path: Path, trained: Trained) -> None:
    """Write the page, atomically.

    Raises:
        UserError: a photo is absent or damaged.
        OSError: the file cannot be written.
    """
    held_out = trained.evaluation is not None and bool(trained.evaluation.views)
    views = trained.capture.test
    if not held_out:
        views = trained.capture.train
        views = views[:: -(-len(views) // _TRAINING_VIEWS)]
    with single_threaded():
        evaluation = trained.evaluation
        if evaluation is None or not held_out:
            evaluation = evaluate_views(trained.gaussians, views, background=trained.background)
        body = [
            _headline(trained, evaluation, held_out),
            _cards(trained, evaluation, held_out),
            _curves(trained.history),
            _pictures(trained, views, evaluation),
            _figures(evaluation, held_out),
            _settings(trained),
            _machine(trained),
            _next(trained.name),
        ]
    write_text(path, page(f"{trained.name} – training", body, _STYLE))


# The parts of the page, from top to bottom


def _headline(trained: Trained, evaluation: Evaluation, held_out: bool) -> str:
    count = len(evaluation.views)
    photos = f"{count} photo" if count == 1 else f"{count} photos"
    if held_out:
        verdict = f"Measured on {photos} that the training has never seen."
    else:
        verdict = (
            f"No photos were held out, so this was measured on {photos} of the training, which "
            "flatters it; --eval holds out every 8th."
        )
    return f"<h1>{text(trained.name)}</h1>\n<p>{verdict}</p>"


def _cards(trained: Trained, evaluation: Evaluation, held_out: bool) -> str:
    where = "held-out photos" if held_out else "training photos"
    figures = [
        (f"{evaluation.psnr:.2f} dB", f"PSNR, {where}"),
        (f"{evaluation.ssim:.3f}", f"SSIM, {where}"),
        (f"{len(trained.gaussians):,}", "Gaussians"),
        (f"{trained.step:,}", "steps"),
        (duration(trained.history.seconds), "of training"),
    ]
    return cards(figures)


def _curves(history: History) -> str:
    stretches = history.stretches
    window = max(1, len(stretches) // _SMOOTHED)
    loss = [(float(s.step), s.loss) for s in stretches]
    psnr = [(float(m.step), m.psnr) for m in history.measured]
    milliseconds = [(float(s.step), 1000 * s.seconds / s.steps) for s in stretches]
    drawings = [
        (
            "Loss",
            charts.chart(charts.smoothed(loss, window), raw=loss, x_label="steps", y_label="loss"),
        ),
        (
            "PSNR of the held-out photos, dB",
            charts.chart(
                psnr if len(psnr) > 1 else [],  # one is told above
                x_label="steps",
                y_label="PSNR, dB",
                dots=True,
                from_zero=False,
            ),
        ),
        (
            "Gaussians",
            charts.chart(
                [(float(s.step), float(s.gaussians)) for s in stretches],
                x_label="steps",
                y_label="Gaussians",
            ),
        ),
        (
            "Time of a step, ms",
            charts.chart(
                charts.smoothed(milliseconds, window),
                raw=milliseconds,
                x_label="steps",
                y_label="time of a step, ms",
            ),
        ),
    ]
    figures = "\n".join(
        f"<figure><figcaption>{caption}</figcaption>{svg}</figure>"
        for caption, svg in drawings
        if svg
    )
    return f'<h2>The training</h2>\n<div class="charts">{figures}</div>' if figures else ""


def _pictures(trained: Trained, views: Sequence[View], evaluation: Evaluation) -> str:
    """Photo, render and error of the views with the lowest and the highest PSNR."""
    order = sorted(evaluation.views, key=lambda figures: figures.psnr)
    if len(order) <= _WORST + _BEST:
        groups = [("Photo, render, error", order)]
    else:
        groups = [
            ("Least like their photos", order[:_WORST]),
            ("Most like them", order[: -_BEST - 1 : -1]),
        ]
    by_name = {view.name: view for view in views}
    parts = []
    with ImageLoader(views) as loader:
        for title, chosen in groups:
            figures = "\n".join(
                _triple(trained, by_name[one.name], one, loader)
                for one in chosen
                if one.name in by_name
            )
            parts.append(f'<h2>{title}</h2>\n<div class="views">{figures}</div>')
    white = f"{100 * _WHITE_ERROR:.0f}%"
    parts.append(
        '<p class="soft">Photo, render, and error: the mean difference of red, green and blue, '
        f"from black (none) to white ({white} of the range, or more).</p>"
    )
    return "\n".join(parts)


def _triple(trained: Trained, view: View, figures: ViewMetrics, loader: ImageLoader) -> str:
    color = torch.tensor(trained.background)
    loaded = loader.get(view)
    photo = loaded.over(color)
    with torch.no_grad():
        image = render(trained.gaussians, view.camera, color).image.clamp(0.0, 1.0)
    difference = (image - photo).abs().mean(2)
    if loaded.mask is not None:
        difference = torch.where(loaded.mask, difference, 0.0)
    images = "".join(
        picture(_small(pixels), f"{view.name}: {what}", quality=80)
        for what, pixels in (
            ("photo", _bytes(photo)),
            ("render", _bytes(image)),
            ("error", _error_in_color(difference.cpu().numpy())),
        )
    )
    caption = f"{text(view.name)}: PSNR {figures.psnr:.2f} dB, SSIM {figures.ssim:.3f}"
    return f'<figure><div class="triple">{images}</div><figcaption>{caption}</figcaption></figure>'


def _figures(evaluation: Evaluation, held_out: bool) -> str:
    """The list of views, and how far each is off: a bar that begins at zero."""
    errors = [_rms(figures.psnr) for figures in evaluation.views]
    largest = max([*errors, 1e-9])
    rows = [
        [
            text(figures.name),
            f"{figures.psnr:.2f}&#160;dB",
            f"{figures.ssim:.3f}",
            f"{100 * error:.1f}%",
            bar(error / largest),
        ]
        for figures, error in list(zip(evaluation.views, errors, strict=True))[:_LISTED]
    ]
    more = len(evaluation.views) - _LISTED
    rest = f'<p class="soft">… and {more:,} more, see metrics.json.</p>' if more > 0 else ""
    which = "held-out" if held_out else "measured"
    heads = ["photo", "PSNR", "SSIM", "mean error (RMS)", ""]
    return f"<h2>Each {which} photo</h2>\n{table(heads, rows)}{rest}"


def _settings(trained: Trained) -> str:
    capture = trained.capture
    camera = capture.train[0].camera
    points = "none" if capture.points is None else f"{len(capture.points):,}"
    rows = [
        ["photos", f"{len(capture.train)} to train on, {len(capture.test)} held out"],
        ["size", f"{camera.width} × {camera.height}"],
        ["points at the start", points],
        ["degree of the colours (SH)", str(trained.gaussians.sh_degree)],
    ]
    everything = text(json.dumps(trained.settings, indent=2, ensure_ascii=False))
    return (
        f"<h2>Settings</h2>\n{table([], rows)}\n"
        f"<details><summary>All of them</summary><pre>{everything}</pre></details>"
    )


def _machine(trained: Trained) -> str:
    threads = ops.get_num_threads()
    rows = [
        ["processor", text(processor_name())],
        ["threads", f"{threads}, instruction set {native.isa()}"],
        ["system", text(system_name())],
    ]
    memory = [f"{trained.peak_bytes / 1e9:.1f} GB used at most"] if trained.peak_bytes else []
    if memory_bytes():
        memory.append(f"{memory_bytes() / 1e9:.0f} GB there")
    if memory:
        rows.append(["memory", ", ".join(memory)])
    return f"<h2>Machine</h2>\n{table([], rows)}"


def _next(name: str) -> str:
    out = text(shlex.quote(name))
    return f"<h2>Next</h2>\n<pre>snowsplat view {out}\nsnowsplat render {out} --path ellipse</pre>"


# Pictures and figures


def _rms(psnr: float) -> float:
    """Root of the mean square of the differences, of a range of 1."""
    return 0.0 if math.isinf(psnr) else 10.0 ** (-psnr / 20.0)


def _bytes(image: Tensor) -> np.ndarray:
    return (image * 255.0 + 0.5).byte().contiguous().cpu().numpy()


def _error_in_color(difference: np.ndarray) -> np.ndarray:
    """(H, W) in 0..1 -> (H, W, 3) uint8."""
    position = np.clip(difference / _WHITE_ERROR, 0.0, 1.0) * (len(_ERROR_COLORS) - 1)
    low = np.minimum(position.astype(np.int64), len(_ERROR_COLORS) - 2)
    share = (position - low)[:, :, None]
    color = _ERROR_COLORS[low] * (1.0 - share) + _ERROR_COLORS[low + 1] * share
    return np.rint(color).astype(np.uint8)


def _small(pixels: np.ndarray) -> Image.Image:
    image = Image.fromarray(pixels)
    scale = min(1.0, _PICTURE_SIDE / max(image.size))
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.LANCZOS)
