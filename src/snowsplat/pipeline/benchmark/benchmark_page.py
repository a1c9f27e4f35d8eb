"""The tables of a benchmark: text, JSON, CSV, LaTeX, and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import mean
from typing import Any

from PIL import Image

from snowsplat._version import __version__
from snowsplat.pipeline.benchmark.job import WORST, SceneResult
from snowsplat.pipeline.benchmark.suites import SUITES, Figures, Suite
from snowsplat.util.duration import duration
from snowsplat.util.files import write_json, write_text
from snowsplat.util.html import page, picture, table, text

_STYLE = """
.wide { overflow-x: auto; } .wide td, .wide th { white-space: nowrap; }
.wide tr:last-child td { font-weight: 600; }
.worst { display: flex; flex-wrap: wrap; gap: 18px; }
.worst figure { flex: 1 1 420px; } .worst img { max-width: 100%; border-radius: 4px; }
"""


@dataclass(frozen=True)
class BenchmarkReport:
    """The results of a benchmark."""

    suite: str  # a name of `suites.SUITES`
    results: list[SceneResult]
    failures: dict[str, str] = field(default_factory=dict)  # the errors of scenes, by scene

    def as_json(self) -> dict[str, Any]:
        return {
            "snowsplat": __version__,
            "suite": self.suite,
            "results": [asdict(result) for result in self.results],
            "failures": self.failures,
        }

    def rows(self) -> list[dict[str, float | int | str | None]]:
        """A row for each scene, and their mean: the columns of the tables."""
        published = SUITES[self.suite].published
        rows = [_row(result, published.get(result.job.scene)) for result in self.results]
        if rows:
            rows.append({name: _mean(name, [row[name] for row in rows]) for name in rows[0]})
        return rows

    def table(self) -> list[list[str]]:
        """The titles, and the rows as text, without columns that have no values."""
        rows = self.rows()
        used = [name for name in _COLUMNS if any(row[name] is not None for row in rows)]
        titles = [_COLUMNS[name][0] for name in used]
        return [titles, *([_COLUMNS[name][1](row[name]) for name in used] for row in rows)]

    def __str__(self) -> str:
        """The table as text."""
        lines = self.table()
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(
                cell.ljust(width) if i == 0 else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        )


def write_report(folder: Path, report: BenchmarkReport) -> None:
    """Write results.json, results.csv, results.tex and index.html. Raises OSError."""
    write_json(folder / "results.json", report.as_json())
    write_text(folder / "results.csv", _csv(report))
    write_text(folder / "results.tex", _latex(report))
    write_text(folder / "index.html", _page(folder, report))


def _row(result: SceneResult, published: Figures | None) -> dict[str, float | int | str | None]:
    theirs = published or Figures(psnr=float("nan"))
    return {
        "scene": result.job.scene,
        "psnr": result.psnr,
        "ssim": result.ssim,
        "lpips": result.lpips,
        "published_psnr": None if published is None else theirs.psnr,
        "published_ssim": theirs.ssim,
        "published_lpips": theirs.lpips,
        "gaussians": result.gaussians,
        "seconds": result.seconds,
        "memory": result.memory,
    }


def _mean(name: str, values: Sequence[Any]) -> Any:
    if name == "scene":
        return "mean"
    if any(value is None for value in values):  # a mean of other scenes could not be compared
        return None
    average = mean(values)
    return round(average) if name in ("gaussians", "memory") else average


def _decimals(digits: int) -> Callable[[Any], str]:
    return lambda value: "-" if value is None else f"{value:.{digits}f}"


#: The titles of the columns, and how to show their values.
_COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "scene": ("scene", str),
    "psnr": ("PSNR", _decimals(2)),
    "ssim": ("SSIM", _decimals(4)),
    "lpips": ("LPIPS", _decimals(3)),
    "published_psnr": ("published PSNR", _decimals(2)),
    "published_ssim": ("SSIM", _decimals(3)),
    "published_lpips": ("LPIPS", _decimals(3)),
    "gaussians": ("Gaussians", lambda value: f"{value:,}"),
    "seconds": ("time", duration),
    "memory": ("memory GB", lambda value: f"{value / 1e9:.2f}"),
}


def _csv(report: BenchmarkReport) -> str:
    rows = report.rows()
    text = io.StringIO()
    writer = csv.DictWriter(text, list(_COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[:-1])  # without the mean, which readers compute themselves
    return text.getvalue()


def _latex(report: BenchmarkReport) -> str:
    """A tabular of the package booktabs."""
    titles, *rows = report.table()
    lines = [" & ".join(map(_escaped, line)) + r" \\" for line in rows]
    return "\n".join(
        [
            f"% {SUITES[report.suite].title}; made with snowsplat {__version__}",
            rf"\begin{{tabular}}{{l{'r' * (len(titles) - 1)}}}",
            r"\toprule",
            " & ".join(titles) + r" \\",
            r"\midrule",
            *lines[:-1],
            r"\midrule",
            *lines[-1:],
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _escaped(cell: str) -> str:
    for sign in "\\&%$#_{}":
        cell = cell.replace(sign, r"\textbackslash " if sign == "\\" else "\\" + sign)
    return cell


def _page(folder: Path, report: BenchmarkReport) -> str:
    suite = SUITES[report.suite]
    heads, *rows = [[text(cell) for cell in line] for line in report.table()]
    parts = [
        f"<h1>{text(suite.title)}</h1>",
        f"<p class='soft'>{text(_how(report, suite))}</p>",
        f"<div class='wide'>{table(heads, rows)}</div>",
        f"<p class='soft'>{text(_sources(suite))}</p>",
        *(f"<p class='bad'>{text(line)}</p>" for line in report.failures.values()),
        "<h2>The view with the lowest PSNR of each scene: photo, rendering</h2>",
        "<div class='worst'>",
        *(_figure(folder, result) for result in report.results),
        "</div>",
    ]
    return page(f"{suite.title} - snowsplat", parts, _STYLE)


def _how(report: BenchmarkReport, suite: Suite) -> str:
    recipes = sorted({result.job.recipe for result in report.results})
    machines = sorted({result.machine for result in report.results})
    changed = {name: v for r in report.results for name, v in r.job.settings.items()}
    settings = ", ".join(f"{name} {value}" for name, value in changed.items())
    return (
        f"{suite.protocol} Recipe {', '.join(recipes)}{f' ({settings})' if settings else ''}, "
        f"snowsplat {__version__}, {', '.join(machines)}. The metrics are computed from renderings "
        "that are not rounded to 8 bits. The memory is the peak of the process."
    )


def _sources(suite: Suite) -> str:
    if not suite.published:
        return ""
    return (
        f"Published: {suite.source}. The scenes and test photos are the same, the machines are "
        "not. The figures can be compared exactly only if the photos are the official smaller ones."
    )


def _figure(folder: Path, result: SceneResult) -> str:
    file = folder / result.job.scene / WORST
    name, size = result.job.scene, "×".join(map(str, result.size))
    caption = (
        f"{name}: {result.worst}, {size}; {result.photos[0]} training photos, "
        f"{result.photos[1]} test photos"
    )
    image = picture(Image.open(file).convert("RGB"), f"{name}, {result.worst}")
    return f"<figure>{image}<figcaption>{text(caption)}</figcaption></figure>"
