"""Compares training recipes on real datasets: held-out PSNR and SSIM against processor time.

    python benchmarks/recipes.py classic default --out out/recipes
    python benchmarks/recipes.py default default:dropout=0 --captures fern --seeds 3

An arm is a recipe, with changed settings if necessary: RECIPE[:SETTING=VALUE,...]. Each arm is
trained on each dataset, with each hold-out and seed. The arms take turns, and each run uses one
thread; `--jobs` runs are active at a time. A run that is in OUT is not repeated, so the same
command resumes after an interruption. Use another OUT after a change of the code.

Writes OUT/report.html: one table, curves over processor time, and the worst views side by side.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from recipes_report import Run, print_table, write_report

ROOT = Path(__file__).resolve().parents[1]
CAPTURES = ("fox_small", "fox", "fern", "kitchen25", "lego400")
HOLD_OUTS = ("eighth", "sector")
#: Settings that a dataset needs, with every recipe.
DATASET_SETTINGS: dict[str, dict[str, Any]] = {"lego400": {"background": "white"}}


@dataclass(frozen=True)
class Arm:
    """A recipe with changed settings; ``name`` is its text on the command line."""

    name: str
    recipe: str
    settings: dict[str, Any]

    @staticmethod
    def parse(text: str) -> Arm:
        """RECIPE or RECIPE:SETTING=VALUE,SETTING=VALUE."""
        recipe, _, rest = text.partition(":")
        settings = {}
        for part in filter(None, rest.split(",")):
            name, equals, value = part.partition("=")
            if not equals:
                raise argparse.ArgumentTypeError(f"{part}: write it as SETTING=VALUE")
            try:
                settings[name] = ast.literal_eval(value)
            except (ValueError, SyntaxError):
                settings[name] = value
        return Arm(text, recipe, settings)


@dataclass(frozen=True)
class Job:
    """One training run."""

    capture: str
    hold_out: str
    seed: int
    arm: Arm

    @property
    def label(self) -> str:
        """For messages."""
        return f"{self.capture}, {self.hold_out}, seed {self.seed}, {self.arm.name}"

    def request(self, flags: argparse.Namespace, pictures: Path) -> dict[str, Any]:
        """The request for `recipes_worker.py`."""
        return {
            "dataset": str((flags.datasets / self.capture).resolve()),
            "resolution": flags.resolution,
            "hold_out": self.hold_out,
            "recipe": self.arm.recipe,
            "settings": DATASET_SETTINGS.get(self.capture, {}) | self.arm.settings,
            "seed": self.seed,
            "milestones": flags.milestones,
            "pictures": str(pictures) if self.seed == flags.first_seed else None,
        }

    def run(self, flags: argparse.Namespace) -> Run | None:
        """Train in a child process, or read the result of an earlier run; None if it failed."""
        digest = hashlib.sha256(json.dumps(self.request(flags, Path()), sort_keys=True).encode())
        folder = flags.out / "runs" / f"{self.capture}-{digest.hexdigest()[:12]}"
        result = folder / "result.json"
        request = self.request(flags, folder)
        if not result.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "request.json").write_text(json.dumps(request, indent=1), encoding="utf-8")
            worker = Path(__file__).with_name("recipes_worker.py")
            environment = os.environ | {"OMP_NUM_THREADS": "1", "SNOWSPLAT_THREADS": "1"}
            child = subprocess.run(
                [sys.executable, str(worker), str(folder / "request.json")],
                env=environment,
                capture_output=True,
                text=True,
            )
            if child.returncode != 0:
                print(f"{self.label}: failed\n{child.stderr}", file=sys.stderr, flush=True)
                return None
            partial = result.with_suffix(".partial")
            partial.write_text(child.stdout.splitlines()[-1], encoding="utf-8")
            partial.replace(result)
        values = json.loads(result.read_text(encoding="utf-8"))
        print(
            f"{self.label}: {values['psnr']:.2f} dB, {values['ssim']:.4f}, "
            f"{values['gaussians']:,} Gaussians, {values['seconds']:.0f} s",
            flush=True,
        )
        return Run(self.capture, self.hold_out, self.seed, self.arm.name, folder, values)


def jobs(flags: argparse.Namespace) -> list[Job]:
    """All runs; the arms of one dataset, hold-out and seed follow each other."""
    seeds = range(flags.first_seed, flags.first_seed + flags.seeds)
    found = []
    for seed, capture, hold_out in product(seeds, flags.captures, flags.hold_outs):
        if (flags.datasets / capture).exists():
            found += [Job(capture, hold_out, seed, arm) for arm in flags.arms]
        elif seed == flags.first_seed and hold_out == flags.hold_outs[0]:
            print(f"{capture}: skipped, not in {flags.datasets}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("arms", nargs="+", type=Arm.parse, metavar="ARM")
    parser.add_argument("--captures", nargs="+", default=CAPTURES, help="names of datasets")
    parser.add_argument("--hold-outs", nargs="+", default=HOLD_OUTS, choices=HOLD_OUTS)
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at a time")
    parser.add_argument("--milestones", type=int, default=6, help="points of a curve")
    parser.add_argument("-r", "--resolution", type=int, help="as for `snowsplat train`")
    parser.add_argument(
        "--datasets", type=Path, default=ROOT.parent / "shared" / "captures", help="their folder"
    )
    parser.add_argument("--out", type=Path, default=Path("out/recipes"))
    flags = parser.parse_args()
    with ThreadPoolExecutor(flags.jobs) as pool:
        runs = [run for run in pool.map(lambda job: job.run(flags), jobs(flags)) if run]
    if runs:
        print_table(runs, [arm.name for arm in flags.arms])
        print(write_report(flags.out, runs, [arm.name for arm in flags.arms]))


if __name__ == "__main__":
    main()
