"""report.html: the course and the result of a training run, as one self-contained page."""

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from snowsplat import ops
from snowsplat.data import Dataset
from snowsplat.evaluation.metrics import Evaluation, evaluate_views
from snowsplat.evaluation.verdict import Verdict
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.history import History
from snowsplat.training.parts.part import PartReport, Section
from snowsplat.training.report import pictures
from snowsplat.util import charts
from snowsplat.util.files import write_text
from snowsplat.util.html import render_page
from snowsplat.util.machine import memory_bytes, system_name
from snowsplat.util.messages import Message, message
from snowsplat.util.process import single_threaded

#: Number of training views that are evaluated if no views were held out.
_TRAINING_VIEWS = 8
#: Largest number of views in the table.
_LISTED = 200
#: Curves are averaged over this many parts of the training.
_SMOOTHED = 40


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
    parts: Sequence[PartReport] = ()  # what the parts of the training report
    # What is doubtful about the cameras of the dataset, a sentence each.
    doubts: tuple[Message, ...] = ()
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
        errors = [(metrics, _rms(metrics.psnr)) for metrics in evaluation.views]
        page = render_page(
            "training/report/training_report.html.j2",
            title=f"{trained.name} – training",
            trained=trained,
            evaluation=evaluation,
            held_out=held_out,
            sections=_sections(trained),
            curves=_curves(trained.history),
            groups=pictures.compared(trained.gaussians, views, evaluation, trained.background),
            white_error=pictures.WHITE_ERROR,
            errors=errors,
            largest_error=max([error for _, error in errors], default=0.0) or 1.0,
            listed=_LISTED,
            settings=json.dumps(trained.settings, indent=2, ensure_ascii=False),
            machine=_machine(trained),
            folder=shlex.quote(trained.folder),
        )
    write_text(path, page)


def _curves(history: History) -> list[tuple[Message, Markup]]:
    """Captions and drawings of the course of the training; "" if there is nothing to draw."""
    stretches = history.stretches
    window = max(1, len(stretches) // _SMOOTHED)
    loss = [(float(s.step), s.loss) for s in stretches]
    psnr = [(float(m.step), m.psnr) for m in history.measured]
    gaussians = [(float(s.step), float(s.gaussians)) for s in stretches]
    times = [(float(s.step), 1000 * s.seconds / s.steps) for s in stretches]
    steps = message("steps")

    def smooth(points: list[tuple[float, float]], label: Message) -> Markup:
        curve = charts.smoothed(points, window)
        return charts.chart(curve, raw=points, x_label=steps, y_label=label)

    # A single PSNR is in the headline.
    psnr_drawing = charts.chart(
        psnr if len(psnr) > 1 else [],
        x_label=steps,
        y_label="PSNR, dB",
        dots=True,
        from_zero=False,
    )
    count = message("Gaussians")
    drawings = [
        (message("Loss"), smooth(loss, message("loss"))),
        (message("PSNR of the held-out photos, dB"), psnr_drawing),
        (count, charts.chart(gaussians, x_label=steps, y_label=count)),
        (message("Time of a step, ms"), smooth(times, message("time of a step, ms"))),
    ]
    return [(caption, drawing) for caption, drawing in drawings if drawing]


def _sections(trained: Trained) -> list[tuple[Section, list[pictures.Masked], Markup]]:
    """The sections of the parts, with their photos and charts."""
    return [
        (section, pictures.masked(trained.dataset.train, section.masks), _chart(section))
        for part in trained.parts
        for section in part.sections
    ]


def _chart(section: Section) -> Markup:
    """The values of the training photos, in the order of their names; "" if there are none."""
    return charts.chart(
        [(float(i), value) for i, value in enumerate(section.values, 1)],
        x_label=message("training photo"),
        y_label=section.label or "",
        dots=True,
        from_zero=False,
    )


def _machine(trained: Trained) -> list[tuple[Message, Message | str]]:
    rows: list[tuple[Message, Message | str]] = [
        (message("trained on"), ops.device_name(trained.gaussians.means.device)),
        (message("system"), system_name()),
    ]
    memory = []
    if trained.peak_bytes:
        memory.append(message("{gb:.1f} GB peak", gb=trained.peak_bytes / 1e9))
    if memory_bytes():
        memory.append(message("{gb:.0f} GB installed", gb=memory_bytes() / 1e9))
    if memory:
        rows.append((message("memory"), message("{parts}", parts=memory)))
    return rows


def _rms(psnr: float) -> float:
    """Root mean square error, for values in 0..1."""
    return 0.0 if math.isinf(psnr) else 10.0 ** (-psnr / 20.0)
