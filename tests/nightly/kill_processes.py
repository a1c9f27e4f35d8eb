"""Kills one of four processes of a training at random times; another number of processes resumes.

    PYTHONPATH=src python tests/nightly/kill_processes.py --kills 20

After each kill, all processes must end with exit code 2 and one line. The training then continues
with `--resume` and 1, 2 or 3 processes (or begins again if there was no checkpoint yet), and must
write the scene of a training that nobody disturbed, to the bit. If not, the exit code is 1.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from snowsplat.synthetic.toy_dataset import write_toy_dataset

PROCESSES = 4
FLAGS = ["--iterations", "400", "--batch", "4", "--checkpoint-every", "40", "--eval", "-q"]
SCENE = "point_cloud/iteration_400/point_cloud.ply"


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "snowsplat", "train", *map(str, arguments)]


def children(parent: int) -> list[int]:
    return [int(n) for n in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def kill_one(dataset: Path, out: Path, after: float, victim: int) -> str:
    """Kill a process; what is wrong with the reaction, or "", or "finished" if it was too late."""
    run = subprocess.Popen(
        command(dataset, "-o", out, *FLAGS, "--processes", PROCESSES),
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(after)
    if run.poll() is not None:
        return "finished"
    ranks = children(run.pid)
    if len(ranks) < PROCESSES:  # it is just starting or ending
        run.communicate(timeout=120)
        return "finished"
    os.kill(ranks[victim], signal.SIGKILL)
    killed = time.monotonic()
    _, errors = run.communicate(timeout=120)
    seconds = time.monotonic() - killed
    print(f"  ended {seconds:.1f} s later: {errors.strip()}")
    if run.returncode == 0:
        return "finished"
    if run.returncode != 2 or len(errors.splitlines()) != 1 or seconds > 20:
        return f"exit code {run.returncode} after {seconds:.1f} s:\n{errors}"
    return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        dataset = write_toy_dataset(root / "dataset", "colmap-bin", 9, 48, 36, n_points=300)
        undisturbed = command(dataset, "-o", root / "alone", *FLAGS, "--processes", PROCESSES)
        begin = time.monotonic()
        subprocess.run(undisturbed, check=True)
        duration = time.monotonic() - begin
        expected = (root / "alone" / SCENE).read_bytes()
        done = 0
        while done < args.kills:
            out = root / f"{done}"
            after, victim = chance.uniform(0.5, duration), chance.randrange(PROCESSES)
            print(f"kill {done + 1}: process {victim} after {after:.1f} of {duration:.1f} s")
            problem = kill_one(dataset, out, after, victim)
            if problem == "finished":
                continue
            processes = chance.choice([1, 2, 3])
            resumed = [dataset, "-o", out, *FLAGS, "--resume", "--processes", processes]
            if not problem and subprocess.run(command(*resumed)).returncode != 0:
                problem = f"resuming with {processes} processes failed"
            if not problem and (out / SCENE).read_bytes() != expected:
                problem = f"resuming with {processes} processes wrote another scene"
            if problem:
                sys.exit(f"kill {done + 1}: {problem}")
            print(f"  resumed with {processes} processes: the same scene")
            done += 1


if __name__ == "__main__":
    main()
