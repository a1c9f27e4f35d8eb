"""How likely is it that gradient descent finds the optimum?

    python experiments/basins/run.py

fits Gaussians to signals on a line and to small images, from thousands of random starts, and counts
how often the optimum is found: by the distance and the width of the start, the number of Gaussians,
the optimiser, the density control, and with a target that is blurred at first. The results are in
results.json beside this file; docs/learn/initialisation.md describes them.

Learning rates and amounts of noise are chosen with a seed that is not used for the results.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import mixtures
import one_gaussian
import pictures
import torch
from result import Row


def studies(restarts: int, steps: int, seeds: int) -> dict[str, Iterator[Row]]:
    """The rows of all studies, which are computed when they are read."""
    return {
        "basin": one_gaussian.basin(restarts, steps),
        "travel": one_gaussian.travel(steps),
        "width": one_gaussian.width(restarts, steps),
        "blur": one_gaussian.blur(restarts, steps),
        "adam": one_gaussian.adam_limits(max(restarts // 3, 2), steps),
        "two targets": one_gaussian.two_targets(restarts, steps),
        "escape": one_gaussian.escape(5 * restarts),
        "counts": mixtures.counts(restarts, seeds, steps),
        "failures": mixtures.failures(restarts, seeds, steps),
        "rules": mixtures.rules(restarts, seeds, steps),
        "cutoff": pictures.cutoff(max(restarts // 12, 2), steps // 3),
        "images": pictures.rules(seeds, steps * 3 // 10),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--restarts", type=int, default=100, help="for each seed and each setting")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name("results.json"))
    options = parser.parse_args()
    if min(options.restarts, options.steps, options.seeds) < 1:
        parser.error("--restarts, --steps and --seeds must be at least 1")
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name, study in studies(options.restarts, options.steps, options.seeds).items():
        began = time.process_time()
        found = list(study)
        rows += found
        print(f"{name}: {len(found)} rows, {time.process_time() - began:.0f} s", flush=True)
        text = ",\n".join(json.dumps(row) for row in rows)
        options.output.write_text(f"[\n{text}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
