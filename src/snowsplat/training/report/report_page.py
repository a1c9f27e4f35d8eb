"""report.html: the course and the result of a training run, as one self-contained page."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from snowsplat import ops
from snowsplat.data import Dataset
from snowsplat.evaluation import verdict
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.evaluation.verdict import Verdict
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.history import History
from snowsplat.training.report import masks, pictures
from snowsplat.util import charts
from snowsplat.util.duration import duration
from snowsplat.util.files import write_text
from snowsplat.util.html import bar, cards, page, table, text
from snowsplat.util.machine import memory_bytes, system_name
from snowsplat.util.messages import message
from snowsplat.util.process import single_threaded

#: Number of training views that are evaluated if no views were held out.
_TRAINING_VIEWS = 8
#: Largest number of views in the table.
_LISTED = 200
#: Curves are averaged over this many parts of the training.
_SMOOTHED = 40

_STYLE = (
    charts.STYLE
    + pictures.STYLE
    + masks.STYLE
    + verdict.STYLE
    + """
td { font-variant-numeric: tabular-nums; }
"""
)


@dataclass(frozen=True)
class Trained:
    """The content of the page."""

    name: str  # name of the scene
    folder: str  # where the commands at the end of the page find it
    dataset: Dataset
    gaussians: Gaussians
    step: int  # the last step
    background: tuple[float, float, float]  # background colour of the views, RGB in 0..1
    history: History
    # Metrics of the held-out views; if there are none, some training views are evaluated.
    evaluation: Evaluation | None
    settings: dict[str, Any]  # the settings by name, as JSON values
    left_out: tuple[str, ...] = ()  # names of the training views that the training has left out
    # The learnt exposure of each training view in EV; empty if none is learnt.
    exposures: tuple[float, ...] = ()
    # The masks of what moves, by the name of the training view; see `Transients.pictures`.
    masks: Mapping[str, Image.Image] = field(default_factory=dict)
    poses: str | None = None  # the line about the camera poses; None if there is nothing to say
    # What is doubtful about the cameras of the dataset, a sentence each.
    doubts: tuple[str, ...] = ()
    verdict: Verdict | None = None  # the verdict on the scene; None if no photos were held out
    peak_bytes: int = 0  # peak memory; 0 if unknown
    of_make: bool = False  # whether `make` trains the scene


def write_training_report(path: Path, trained: Trained) -> None:
    """Write the page, atomically.

    Raises:
        UserError: a photo is missing or damaged.
        OSError: the file cannot be written.
    """
    held_out = trained.evaluation is not None and bool(trained.evaluation.views)
    views = trained.dataset.test
    if not held_out:
        views = [v for v in trained.dataset.train if v.name not in trained.left_out]
        views = views[:: -(-len(views) // _TRAINING_VIEWS)]
    with single_threaded():
        evaluation = trained.evaluation
        if evaluation is None or not held_out:
            evaluation = evaluate_views(trained.gaussians, views, background=trained.background)
        body = [
            _headline(trained, evaluation, held_out),
            "" if trained.verdict is None else trained.verdict.html(message("the scene")),
            _cards(trained, evaluation, held_out),
            _left_out(trained.left_out),
            masks.masked(trained.dataset.train, trained.masks),
            _poses(trained.poses),
            *map(_poses, trained.doubts),
            _curves(trained.history),
            _exposures(trained.exposures),
            pictures.compared(trained.gaussians, views, evaluation, trained.background),
            _figures(evaluation, held_out),
            _settings(trained),
            _machine(trained),
            _next(trained.folder),
        ]
    write_text(path, page(f"{trained.name} – training", body, _STYLE))


# The parts of the page, from top to bottom


def _headline(trained: Trained, evaluation: Evaluation, held_out: bool) -> str:
    count = len(evaluation.views)
    photos = f"{count} photo" if count == 1 else f"{count} photos"
    if held_out:
        how = f"Evaluated on {photos} of {evaluation.size} that were not used for training."
        if trained.of_make:
            how += (
                " If there is time, make ends with a short training on all photos; all figures are "
                "those of the scene before."
            )
    else:
        how = (
            f"No photos were held out: these are the metrics of {photos} of {evaluation.size} used "
            "for training, which are better than those of new views. Use --eval to hold out every "
            "8th photo."
        )
    return f"<h1>{text(trained.name)}</h1>\n<p>{how}</p>"


def _cards(trained: Trained, evaluation: Evaluation, held_out: bool) -> str:
    where = f"{'held-out' if held_out else 'training'} photos of {evaluation.size}"
    figures = [
        (f"{evaluation.psnr:.2f} dB", f"PSNR, {where}"),
        (f"{evaluation.ssim:.3f}", f"SSIM, {where}"),
        (f"{evaluation.psnr_aligned:.2f} dB", f"colour-aligned PSNR, {where}"),
        (f"{len(trained.gaussians):,}", "Gaussians"),
        (f"{trained.step:,}", "steps"),
        (duration(trained.history.seconds), "of training"),
    ]
    return cards(figures)


def _poses(line: str | None) -> str:
    return "" if line is None else f"<p>{text(line[:1].upper() + line[1:])}.</p>"


def _left_out(names: tuple[str, ...]) -> str:
    """The photos whose poses are probably wrong."""
    if not names:
        return ""
    rest = f" and {len(names) - _LISTED:,} more" if len(names) > _LISTED else ""
    return (
        f"<h2>Photos that the scene does not explain</h2>\n<p>Left out of the training, because "
        f"their camera poses are probably wrong: {text(', '.join(names[:_LISTED]))}{rest}.</p>"
    )


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
                psnr if len(psnr) > 1 else [],  # a single value is in the headline
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


def _exposures(exposures: tuple[float, ...]) -> str:
    """The exposures of the training photos, in the order of their names."""
    if not any(exposures):
        return ""
    drawing = charts.chart(
        [(float(i), ev) for i, ev in enumerate(exposures, 1)],
        x_label="training photo",
        y_label="exposure, EV",
        dots=True,
        from_zero=False,
    )
    return (
        "<h2>Exposures of the photos</h2>\n<p>In EV (factors of two of light), relative to their "
        "mean, which is the exposure of the scene.</p>\n"
        f'<div class="charts"><figure>{drawing}</figure></div>'
    )


def _figures(evaluation: Evaluation, held_out: bool) -> str:
    """The table of views. A bar shows the error of each view."""
    errors = [_rms(metrics.psnr) for metrics in evaluation.views]
    largest = max([*errors, 1e-9])
    rows = [
        [
            text(metrics.name),
            f"{metrics.psnr:.2f}&#160;dB",
            f"{metrics.ssim:.3f}",
            f"{metrics.psnr_aligned:.2f}&#160;dB",
            f"{100 * error:.1f}%",
            bar(error / largest),
        ]
        for metrics, error in list(zip(evaluation.views, errors, strict=True))[:_LISTED]
    ]
    more = len(evaluation.views) - _LISTED
    rest = f'<p class="soft">… and {more:,} more, see metrics.json.</p>' if more > 0 else ""
    which = "held-out" if held_out else "evaluated"
    heads = ["photo", "PSNR", "SSIM", "colour-aligned PSNR", "RMS error", ""]
    return f"<h2>Each {which} photo</h2>\n{table(heads, rows)}{rest}"


def _settings(trained: Trained) -> str:
    dataset = trained.dataset
    camera = dataset.train[0].camera
    points = "none" if dataset.points is None else f"{len(dataset.points):,}"
    rows = [
        ["photos", f"{len(dataset.train)} to train on, {len(dataset.test)} held out"],
        ["size", f"{camera.width} × {camera.height}"],
        ["initial points", points],
        ["degree of the spherical harmonics", str(trained.gaussians.sh_degree)],
    ]
    everything = text(json.dumps(trained.settings, indent=2, ensure_ascii=False))
    return (
        f"<h2>Settings</h2>\n{table([], rows)}\n"
        f"<details><summary>All settings</summary><pre>{everything}</pre></details>"
    )


def _machine(trained: Trained) -> str:
    rows = [
        ["trained on", text(ops.device_name(trained.gaussians.means.device))],
        ["system", text(system_name())],
    ]
    memory = [f"{trained.peak_bytes / 1e9:.1f} GB peak"] if trained.peak_bytes else []
    if memory_bytes():
        memory.append(f"{memory_bytes() / 1e9:.0f} GB installed")
    if memory:
        rows.append(["memory", ", ".join(memory)])
    return f"<h2>Machine</h2>\n{table([], rows)}"


def _next(folder: str) -> str:
    out = text(shlex.quote(folder))
    return f"<h2>Next</h2>\n<pre>snowsplat view {out}\nsnowsplat render {out} --path ellipse</pre>"


def _rms(psnr: float) -> float:
    """Root mean square error, for values in 0..1."""
    return 0.0 if math.isinf(psnr) else 10.0 ** (-psnr / 20.0)
