"""Held-out PSNR against training time, of a dataset and one or more recipes.

    python benchmarks/train.py ../shared/captures/fox_small -o out/benchmark
    python benchmarks/train.py DATASET -o OUT --recipe default paper --iterations 7000
    python benchmarks/train.py DATASET -o OUT --set max_gaussians=50000 sh_interval=100

Writes OUT/DATASET.csv, .json and .svg. The clock is stopped while held-out views are evaluated. The
time includes the initialisation of the Gaussians.
"""

import argparse
import ast
import csv
import json
import resource
import sys
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from plot import line_chart

from snowsplat import Dataset, TrainConfig, Trainer, UserError, load_dataset, ops, recipe
from snowsplat.training.settings.recipes import RECIPES


@dataclass(frozen=True)
class Milestone:
    """A row of the table.

    Attributes:
        seconds: wall time of the training so far.
        cpu_seconds: processor time of the training, all threads (also those that decode photos).
        peak_mb: peak memory of the process so far, with Python and PyTorch.
    """

    recipe: str
    steps: int
    seconds: float
    cpu_seconds: float
    psnr: float
    ssim: float
    gaussians: int
    peak_mb: float


def milestones(iterations: int, count: int) -> list[int]:
    """Steps at which to evaluate, at growing distances: every second one doubles the step."""
    steps = {max(1, round(iterations * 2.0 ** (-i / 2))) for i in range(count)}
    return sorted(steps)


def train(dataset: Dataset, name: str, config: TrainConfig, count: int) -> list[Milestone]:
    """Train, and print a row at each milestone."""
    clock = _Clock()
    with clock:
        trainer = Trainer(dataset, config)
    rows = []
    for step in milestones(config.iterations, count):
        with clock:
            trainer.run(until=step)
        peak = _peak_mb()
        found = trainer.evaluate()
        row = Milestone(
            *(name, step, clock.wall, clock.cpu, found.psnr, found.ssim),
            gaussians=len(trainer.gaussians),
            peak_mb=peak,
        )
        rows.append(row)
        print(
            f"{name:<10}{row.steps:>7}{row.seconds:>10.1f}{row.cpu_seconds:>10.1f}"
            f"{row.psnr:>8.2f}{row.ssim:>7.3f}{row.gaussians:>11,}{row.peak_mb:>9.0f}",
            flush=True,
        )
    return rows


class _Clock:
    """Wall and processor seconds spent within its `with` blocks."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0

    def __enter__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        self.wall += time.perf_counter() - self._wall
        self.cpu += time.process_time() - self._cpu


def _peak_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def main() -> None:
    flags = _flags()
    settings = dict(setting(text) for text in flags.set)
    if flags.threads:
        ops.set_num_threads(flags.threads)
    start = _peak_mb()
    dataset = load_dataset(flags.dataset, resolution=flags.resolution)
    if not dataset.test:
        raise UserError(f"{flags.dataset}: too few photos to hold one out")
    camera = dataset.train[0].camera
    print(
        f"{flags.dataset.name}: {len(dataset.train)} photos to train on, {len(dataset.test)} held "
        f"out, {camera.width}x{camera.height}; {ops.get_num_threads()} threads; "
        f"{start:.0f} MB are Python and PyTorch"
    )
    print(
        f"{'recipe':<10}{'steps':>7}{'seconds':>10}{'cpu s':>10}{'PSNR':>8}{'SSIM':>7}"
        f"{'Gaussians':>11}{'peak MB':>9}"
    )
    rows: list[Milestone] = []
    for name in flags.recipe:
        config = recipe(
            name, iterations=flags.iterations, seed=flags.seed, test_iterations=(), **settings
        )
        rows += train(dataset, name, config, flags.milestones)
    _write(flags, rows, settings)


def _write(flags: argparse.Namespace, rows: list[Milestone], settings: dict[str, Any]) -> None:
    flags.output.mkdir(parents=True, exist_ok=True)
    name = flags.dataset.resolve().name
    stem = flags.output / name
    with stem.with_name(f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Milestone)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    record = {
        "capture": name,
        "seed": flags.seed,
        "threads": ops.get_num_threads(),
        "settings": settings,
        "rows": [asdict(row) for row in rows],
    }
    text = json.dumps(record, indent=1) + "\n"
    stem.with_name(f"{name}.json").write_text(text, encoding="utf-8")
    curves = {
        recipe: [(row.seconds, row.psnr) for row in rows if row.recipe == recipe]
        for recipe in flags.recipe
    }
    chart = line_chart(curves, f"{name}, held out", "seconds of training", "PSNR in dB")
    stem.with_name(f"{name}.svg").write_text(chart, encoding="utf-8")
    print(f"{stem}.csv, .json, .svg")


def setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise UserError(f"--set {text}: write it as NAME=VALUE")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def _flags() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/benchmark"))
    parser.add_argument("--recipe", nargs="+", default=["default"], choices=RECIPES)
    parser.add_argument("--iterations", type=int, help="default: that of the recipe")
    parser.add_argument("-r", "--resolution", type=int, help="as for `snowsplat train`")
    parser.add_argument("--set", nargs="+", default=[], metavar="SETTING=VALUE")
    parser.add_argument("--milestones", type=int, default=12, help="number of evaluations")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"train: {error}")
