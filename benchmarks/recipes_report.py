"""The report of `recipes.py`: one table, curves over processor time, and the worst views."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image
from plot import line_chart

#: Number of views per dataset and hold-out that are shown.
WORST = 2


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        values: the result of `recipes_worker.py`.
    """

    capture: str
    hold_out: str
    seed: int
    arm: str
    folder: Path
    values: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """The means over the seeds of one arm on one dataset and hold-out.

    ``difference`` is the mean difference of the PSNR to the first arm, over the seeds that both
    have; ``spread`` is the standard deviation of these differences (None: fewer than two seeds).
    """

    capture: str
    hold_out: str
    arm: str
    seeds: int
    psnr: float
    ssim: float
    gaussians: float
    pairs: float
    seconds: float
    difference: float
    spread: float | None
    ssim_difference: float
    time_ratio: float


HEADER = (
    "dataset, held out",
    "arm",
    "seeds",
    "PSNR",
    "SSIM",
    "Gaussians",
    "pairs/px",
    "CPU s",
    "dB",
    "±",
    "SSIM diff.",
    "time",
)


def rows(runs: Sequence[Run], arms: Sequence[str]) -> list[Row]:
    """A row for each dataset, hold-out and arm, in the order of the runs."""
    found = []
    for capture, hold_out in dict.fromkeys((run.capture, run.hold_out) for run in runs):
        own = [run for run in runs if (run.capture, run.hold_out) == (capture, hold_out)]
        first = {run.seed: run.values for run in own if run.arm == arms[0]}
        for arm in arms:
            values = {run.seed: run.values for run in own if run.arm == arm}
            both = sorted(values.keys() & first.keys())
            if not both:
                continue

            def mean(
                key: str, of: dict[int, Any] = values, seeds: Sequence[int] = tuple(both)
            ) -> float:
                return statistics.fmean(of[seed][key] for seed in seeds)

            differences = [values[seed]["psnr"] - first[seed]["psnr"] for seed in both]
            found.append(
                Row(
                    *(capture, hold_out, arm, len(both)),
                    *(mean(key) for key in ("psnr", "ssim", "gaussians", "pairs", "seconds")),
                    difference=statistics.fmean(differences),
                    spread=statistics.stdev(differences) if len(both) > 1 else None,
                    ssim_difference=mean("ssim") - mean("ssim", first),
                    time_ratio=mean("seconds") / mean("seconds", first),
                )
            )
    return found


def cells(row: Row) -> tuple[str, ...]:
    """The texts of a row, in the order of `HEADER`."""
    return (
        f"{row.capture}, {row.hold_out}",
        row.arm,
        str(row.seeds),
        f"{row.psnr:.2f}",
        f"{row.ssim:.4f}",
        f"{row.gaussians:,.0f}",
        f"{row.pairs:.1f}",
        f"{row.seconds:.1f}",
        f"{row.difference:+.2f}",
        "" if row.spread is None else f"{row.spread:.2f}",
        f"{row.ssim_difference:+.4f}",
        f"{row.time_ratio:.2f}",
    )


def mean_rows(table: Sequence[Row], arms: Sequence[str]) -> list[tuple[str, ...]]:
    """For each hold-out and arm: the mean differences over the datasets."""
    found = []
    for hold_out in dict.fromkeys(row.hold_out for row in table):
        for arm in arms[1:]:
            own = [row for row in table if (row.hold_out, row.arm) == (hold_out, arm)]
            if not own:
                continue
            difference, ssim, ratio = (
                statistics.fmean(getattr(row, key) for row in own)
                for key in ("difference", "ssim_difference", "time_ratio")
            )
            worst = min(row.difference for row in own)
            found.append(
                (
                    *(f"mean, {hold_out}", arm, "", "", "", "", "", "", f"{difference:+.2f}"),
                    *(f"min {worst:+.2f}", f"{ssim:+.4f}", f"{ratio:.2f}"),
                )
            )
    return found


def print_table(runs: Sequence[Run], arms: Sequence[str]) -> None:
    """The table as text."""
    table = rows(runs, arms)
    lines = [HEADER, *(cells(row) for row in table), *mean_rows(table, arms)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADER))]
    for line in lines:
        texts = [
            text.ljust(width) if i < 2 else text.rjust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        print("  ".join(texts).rstrip())


def write_report(out: Path, runs: Sequence[Run], arms: Sequence[str]) -> Path:
    """Write OUT/report.html and its pictures."""
    out.mkdir(parents=True, exist_ok=True)
    table = rows(runs, arms)
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Recipes</title>",
        "<style>body{font:14px sans-serif;margin:2em}td,th{padding:2px 8px;text-align:right}"
        "td:first-child,td:nth-child(2){text-align:left}img{max-width:100%}</style>",
        "<h1>Recipes</h1><table>",
        _table_row(HEADER, "th"),
        *(_table_row(cells(row)) for row in table),
        *(_table_row(row) for row in mean_rows(table, arms)),
        "</table>",
    ]
    for capture, hold_out in dict.fromkeys((run.capture, run.hold_out) for run in runs):
        own = [run for run in runs if (run.capture, run.hold_out) == (capture, hold_out)]
        title = f"{capture}, {hold_out}"
        parts += [
            f"<h2>{escape(title)}</h2>",
            line_chart(
                _curves(own, arms), title, "processor time of the training in seconds", "PSNR in dB"
            ),
        ]
        for name in _worst_views(own, arms):
            picture = out / f"{capture}-{hold_out}-{Path(name).stem}.png"
            if _side_by_side(own, arms, name, picture):
                caption = f"{name}: photo, {', '.join(arms)}"
                parts.append(f"<p>{escape(caption)}<br><img src='{escape(picture.name)}'></p>")
    page = out / "report.html"
    page.write_text("\n".join(parts), encoding="utf-8")
    return page


def _table_row(texts: Sequence[str], tag: str = "td") -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(text)}</{tag}>" for text in texts) + "</tr>"


def _curves(runs: Sequence[Run], arms: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """For each arm: (processor time, PSNR) at each milestone, means over the seeds."""
    curves = {}
    for arm in arms:
        own = [run.values["curve"] for run in runs if run.arm == arm]
        if own:
            curves[arm] = [
                tuple(
                    statistics.fmean(point[key] for point in points) for key in ("seconds", "psnr")
                )
                for points in zip(*own, strict=True)
            ]
    return curves


def _worst_views(runs: Sequence[Run], arms: Sequence[str]) -> list[str]:
    """The views with the lowest PSNR of the last arm, and those that lost most."""
    last = next((run for run in runs if run.arm == arms[-1]), None)
    first = next((run for run in runs if run.arm == arms[0]), None)
    if last is None or first is None:
        return []
    views, before = last.values["views"], first.values["views"]
    lowest = sorted(views, key=lambda name: views[name]["psnr"])[:WORST]
    lost = sorted(views, key=lambda name: views[name]["psnr"] - before[name]["psnr"])[:1]
    return list(dict.fromkeys([*lowest, *lost]))


def _side_by_side(runs: Sequence[Run], arms: Sequence[str], name: str, to: Path) -> bool:
    """Photo and renderings of a view in one image; False if there are no pictures."""
    images = []
    for arm in arms:
        run = next((run for run in runs if run.arm == arm), None)
        if run is None:
            return False
        index = sorted(run.values["views"]).index(name)
        files = [run.folder / f"{index}.png"]
        if not images:
            files.insert(0, run.folder / f"{index}-photo.png")
        if not all(file.is_file() for file in files):
            return False
        images += [Image.open(file) for file in files]
    height = max(image.height for image in images)
    sheet = Image.new("RGB", (sum(image.width for image in images), height))
    left = 0
    for image in images:
        sheet.paste(image, (left, 0))
        left += image.width
    sheet.save(to)
    return True
