"""What each part of the recipe `default` is worth: held-out PSNR with each part off in turn.

    python benchmarks/parts.py DATASET... --out out/parts.json

Every arm has the same number of steps, and densification every 50 steps, so that only the part
differs; see `OFF`. Exposures are not corrected. One thread. A training that is in the output is not
repeated, so the same command resumes. Prints the table of docs/learn/from-paper-to-default.md: the
mean over the seeds, minus that of `default`.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

from snowsplat import Trainer, load_dataset, ops, recipe
from snowsplat.training.settings.rates import LearningRates

RATES = ("means", "means_final", "log_scales", "quats", "sh_dc", "sh_rest")
#: The part -> the settings that are changed: they are those of the paper, or leave the part out.
OFF: dict[str, dict[str, Any]] = {
    "default": {},
    "rates": {
        **{f"lr_{name}": getattr(LearningRates(), name) for name in RATES},
        "lr_sh_rest_passes": 40.0,
    },
    "sweep": {"init": "points", "initial_points": 1.0},
    "ball": {"initial_opacity": 0.1, "initial_scale": 1.0},
    "coarse": {"coarse_to_fine": (0, 0)},
    "passes": {"lr_sh_rest_passes": 0.0},
    "prune": {"prune_opacity": 0.005},
    "abs": {"abs_grad": False, "grad_threshold": 2e-4},
    "until": {"densify_until": 0.5},
    "decay": {"decay_opacity": 0.0, "decay_scale": 0.0},
    "anneal": {"lr_anneal": 1.0},
    "huber": {"huber_weight": 0.0},
    "beta1": {"beta1": 0.9},
    "near": {"near_limit": 0.0, "relative_scale": 0.0},
    "antialias": {"antialias": False},
}


def train(dataset: Path, resolution: int, settings: dict[str, Any]) -> dict[str, float]:
    """PSNR of the held-out photos, number of Gaussians, and seconds of processor time."""
    begin = time.process_time()
    trainer = Trainer(load_dataset(dataset, resolution=resolution), recipe("default", **settings))
    trainer.run()
    seconds = time.process_time() - begin
    return {
        "psnr": trainer.evaluate().psnr,
        "gaussians": len(trainer.gaussians),
        "seconds": seconds,
        "steps": trainer.step,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("datasets", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--resolution", type=int, nargs="+", default=[1], help="as for train -r")
    parser.add_argument("--seeds", type=int, default=2)
    flags = parser.parse_args()
    ops.set_num_threads(1)
    results = json.loads(flags.out.read_text()) if flags.out.exists() else {}
    factors = flags.resolution * (1 if len(flags.resolution) > 1 else len(flags.datasets))
    fixed = {"iterations": flags.iterations, "few_passes": 0.0, "densify_interval": 50}
    for seed in range(flags.seeds):
        for part, off in OFF.items():
            for dataset, factor in zip(flags.datasets, factors, strict=True):
                key = f"{part} {dataset.name} {seed}"
                if key not in results:
                    settings = {**off, **fixed, "exposure": "off", "seed": seed}
                    results[key] = train(dataset, factor, settings)
                    flags.out.write_text(json.dumps(results, indent=1))
                    print(key, results[key], flush=True)
    for part in OFF:
        cells = []
        for dataset in flags.datasets:
            of = [
                [results[f"{name} {dataset.name} {seed}"] for seed in range(flags.seeds)]
                for name in (part, "default")
            ]
            mean, base = (statistics.mean(run["psnr"] for run in runs) for runs in of)
            time_off, time_on = (statistics.mean(run["seconds"] for run in runs) for runs in of)
            change = f"{mean:.2f}" if part == "default" else f"{mean - base:+.2f}"
            cells.append(f"{change} | {time_off / time_on:.2f}")
        print(f"| {part} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
