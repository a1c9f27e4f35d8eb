"""PSNR of held-out photos after a given number of minutes: one training run for each number.

    python benchmarks/per_minute.py ../shared/captures/lego800 --out out/per_minute
    python benchmarks/per_minute.py A B --minutes 0.5 1 --flags "--recipe classic" --out OUT

Each run is `snowsplat train DATASET --minutes M --eval`: the minutes include reading the photos,
the initialisation and the training, but not the evaluation. PSNR is judged on the held-out photos
at their own size. The runs take turns, one at a time. Nothing else should run on the machine: the
load before each run is written beside its result. A run that is in OUT is not repeated.

Writes OUT/per_minute.json, .md and .svg.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from plot import line_chart

from snowsplat.util.machine import processor_name

MINUTES = (0.25, 0.5, 1.0, 3.0, 6.5, 15.0)


@dataclass(frozen=True)
class Result:
    """One training run.

    Attributes:
        load: number of other active processes when the run began (load average of a minute).
        cpu_seconds: processor time of the training, with its evaluation at the size of the
            training.
        size: of the held-out photos, on which PSNR and SSIM are judged.
    """

    dataset: str
    minutes: float
    psnr: float
    ssim: float
    size: str
    steps: int
    cpu_seconds: float
    load: float


def run(dataset: Path, minutes: float, settings: list[str], folder: Path) -> Result:
    """Train and evaluate in another process."""
    command = [sys.executable, "-m", "snowsplat"]
    train = ["train", str(dataset), "--eval", "--minutes", str(minutes), "--overwrite"]
    load, before = os.getloadavg()[0], _children_seconds()
    subprocess.run([*command, *train, "--output", str(folder), *settings], check=True)
    seconds = _children_seconds() - before
    # The training may have reduced the photos.
    subprocess.run([*command, "evaluate", str(folder), "-r", "1"], check=True)
    found = json.loads((folder / "metrics.json").read_text())
    judged = [found[name] for name in ("psnr", "ssim", "size", "iteration")]
    return Result(dataset.name, minutes, *judged, seconds, load)


def _children_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def table(results: list[Result]) -> str:
    """A Markdown table, and a line about the machine."""
    lines = [
        "| dataset | minutes | PSNR | SSIM | judged at | steps | processor time | load before |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        lines.append(
            f"| {r.dataset} | {r.minutes:g} | {r.psnr:.2f} | {r.ssim:.4f} | {r.size} | {r.steps} "
            f"| {r.cpu_seconds:.0f} s | {r.load:.1f} |"
        )
    return "\n".join([*lines, "", f"{processor_name()}, {os.cpu_count()} cores", ""])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument("--minutes", type=float, nargs="+", default=MINUTES)
    parser.add_argument("--flags", default="", help="further flags of `snowsplat train`")
    parser.add_argument("--out", type=Path, required=True)
    flags = parser.parse_args()
    flags.out.mkdir(parents=True, exist_ok=True)
    stored = flags.out / "per_minute.json"
    results = [Result(**r) for r in json.loads(stored.read_text())] if stored.exists() else []
    for minutes in flags.minutes:
        for dataset in flags.datasets:
            if any(r.dataset == dataset.name and r.minutes == minutes for r in results):
                continue
            folder = flags.out / f"{dataset.name}-{minutes:g}"
            results.append(run(dataset, minutes, flags.flags.split(), folder))
            results.sort(key=lambda r: (r.dataset, r.minutes))
            stored.write_text(json.dumps([asdict(r) for r in results], indent=1))
    (flags.out / "per_minute.md").write_text(table(results))
    curves: dict[str, list[tuple[float, float]]] = {}
    for r in results:
        curves.setdefault(f"{r.dataset}, {r.size}", []).append((r.minutes, r.psnr))
    chart = line_chart(curves, "Quality per minute", "minutes", "PSNR of held-out photos, dB")
    (flags.out / "per_minute.svg").write_text(chart)
    print(table(results))


if __name__ == "__main__":
    main()
