"""Kills commands that write files at random times, and checks that nothing is lost or mixed.

    PYTHONPATH=src python tests/nightly/kill_anywhere.py --kills 200
    PYTHONPATH=src python tests/nightly/kill_anywhere.py --subcommands publish convert studio

"studio" is its worker: edits and exports; "studio-make" its job, from photos to a site.

Each round starts with a new folder and kills the command (SIGKILL, with its children) one to five
times in a row. After each kill it opens all files that have their final names. Then the same
command runs to its end: see tests/kill/harness.py. If a guarantee is violated, the exit code is 1
and the folder is kept.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fork_server import popen
from kill.harness import (
    Defect,
    Job,
    Killer,
    Runner,
    convert_jobs,
    make_jobs,
    publish_jobs,
    sfm_jobs,
    some_gaussians,
    studio_jobs,
    studio_make_jobs,
    train_jobs,
)
from snowsplat.formats import write_gaussians
from snowsplat.synthetic import write_synthetic_photos
from snowsplat.synthetic.toy_dataset import write_toy_dataset

SUBCOMMANDS = ("sfm", "train", "make", "convert", "publish", "studio", "studio-make")
# Shares of all kills; slow subcommands have fewer.
_SHARES = {"sfm": 0.15, "train": 0.25, "make": 0.1, "convert": 0.15, "publish": 0.15}
_SHARES |= {"studio": 0.15, "studio-make": 0.05}


def jobs(folder: Path, subcommands: list[str]) -> list[Job]:
    """The jobs of all subcommands, with small inputs in ``folder``."""
    found: list[Job] = []
    scenes = folder / "in.ply", folder / "other.ply"
    write_gaussians(scenes[0], replace(some_gaussians(4000, 1), origin=(5e5, 20.0, -5.4e6)))
    write_gaussians(scenes[1], some_gaussians(100, 2))
    found += convert_jobs(*scenes) if "convert" in subcommands else []
    found += publish_jobs(*scenes) if "publish" in subcommands else []
    found += studio_jobs(scenes[0]) if "studio" in subcommands else []
    if "train" in subcommands:
        write_toy_dataset(folder / "dataset", "colmap-bin", 9, 48, 36, n_points=300)
        found += train_jobs(folder / "dataset")
    if {"sfm", "make", "studio-make"} & {*subcommands}:
        write_synthetic_photos(folder / "photos", n_views=16, width=320, height=240)
        found += sfm_jobs(folder / "photos") if "sfm" in subcommands else []
        found += make_jobs(folder / "photos") if "make" in subcommands else []
        found += studio_make_jobs(folder / "photos") if "studio-make" in subcommands else []
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200, help="in all, at least (default: 200)")
    parser.add_argument(
        "--subcommands", "--verbs", nargs="+", choices=SUBCOMMANDS, default=list(SUBCOMMANDS)
    )
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the time")
    parser.add_argument("--folder", type=Path, help="to work in (default: a temporary one)")
    flags = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="kill_anywhere_", dir=flags.folder))
    print(f"seed {flags.seed}, in {folder}", flush=True)
    everything = jobs(folder, flags.subcommands)
    share = sum(_SHARES[subcommand] for subcommand in flags.subcommands)
    defects: list[Defect] = []
    start = time.monotonic()
    killer = Killer(Runner(folder / "work", popen), flags.seed)
    for subcommand in flags.subcommands:
        selected = [job for job in everything if job.subcommand == subcommand]
        found = killer.kill(selected, math.ceil(flags.kills * _SHARES[subcommand] / share))
        print_tally(killer, subcommand)
        for defect in found:
            print(f"DEFECT {defect}", flush=True)
        defects += found
    kills = sum(tally.kills for tally in killer.tallies.values())
    print(f"{kills} kills in {time.monotonic() - start:.0f} s, {len(defects)} defects")
    if not defects:
        shutil.rmtree(folder)
    return 1 if defects else 0


def print_tally(killer: Killer, subcommand: str) -> None:
    for name, tally in killer.tallies.items():
        if name.split()[0] == subcommand:
            print(
                f"{name:24}{tally.kills:5} kills in {tally.rounds} rounds, {tally.files} files "
                f"opened after them; {tally.ended} runs ended before their kill",
                flush=True,
            )


if __name__ == "__main__":
    sys.exit(main())
