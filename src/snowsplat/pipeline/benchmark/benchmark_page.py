"""The tables of a benchmark: text, JSON, CSV, LaTeX, and a page."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import mean
from typing import Any

from markupsafe import Markup
from PIL import Image

from snowsplat._version import __version__
from snowsplat.pipeline.benchmark.job import SUITES, WORST, Figures, SceneResult
from snowsplat.util.duration import duration
from snowsplat.util.files import write_json, write_text
from snowsplat.util.html import picture, render_page


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
    "seconds": ("time", lambda value: str(duration(value))),
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
    titles, *rows = report.table()
    results = report.results
    changed = {name: v for result in results for name, v in result.job.settings.items()}
    return render_page(
        "pipeline/benchmark/benchmark_page.html.j2",
        title=f"{suite.title} - snowsplat",
        suite=suite,
        version=__version__,
        titles=titles,
        rows=rows,
        failures=report.failures.values(),
        recipes=", ".join(sorted({result.job.recipe for result in results})),
        machines=", ".join(sorted({result.machine for result in results})),
        settings=", ".join(f"{name} {value}" for name, value in changed.items()),
        worst=[(result, _worst(folder, result)) for result in results],
    )


def _worst(folder: Path, result: SceneResult) -> Markup:
    with Image.open(folder / result.job.scene / WORST) as image:
        return picture(image.convert("RGB"), f"{result.job.scene}, {result.worst}")
