"""Where `find_sky` finds the sky: the share of the photos, for whole datasets and random parts.

    python benchmarks/found_sky.py DATASET [DATASET ...]
    python benchmarks/found_sky.py DATASET --parts 0.5 0.25 --draws 6

A dataset without sky should show 0% in each part; one with sky should show it in most.
"""

from __future__ import annotations

import argparse
import dataclasses
import random
from pathlib import Path

from snowsplat.data import ImageLoader
from snowsplat.data.dataset import Dataset
from snowsplat.data.load import load_dataset
from snowsplat.training.parts.found_sky import find_sky
from snowsplat.util.process import single_threaded

#: A part has at least this number of photos.
FEWEST = 4


def part_of(dataset: Dataset, share: float, seed: int) -> Dataset:
    """``dataset`` with a random share of its photos, in the same order."""
    count = max(FEWEST, round(share * len(dataset.train)))
    chosen = random.Random(seed).sample(range(len(dataset.train)), min(count, len(dataset.train)))
    return dataclasses.replace(dataset, train=[dataset.train[i] for i in sorted(chosen)])


def sky_share(dataset: Dataset, images: ImageLoader) -> str:
    with single_threaded():
        sky = find_sky(dataset, images)
    return "0" if sky is None else f"{100 * sky.share:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument("--parts", type=float, nargs="*", default=[0.5, 0.25])
    parser.add_argument("--draws", type=int, default=6, help="number of random parts of each size")
    options = parser.parse_args()
    parts = "".join(f" {share:g} of them |" for share in options.parts)
    print(f"| dataset | photos | sky, % of the photos |{parts}")
    print("|---|---|---|" + "---|" * len(options.parts))
    for folder in options.datasets:
        dataset = load_dataset(folder, hold_out=None)
        with ImageLoader(dataset.train) as images:
            row = [folder.name, str(len(dataset.train)), sky_share(dataset, images)]
            for share in options.parts:
                drawn = (part_of(dataset, share, seed) for seed in range(options.draws))
                row.append(", ".join(sky_share(part, images) for part in drawn))
        print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
