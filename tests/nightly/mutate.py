"""Puts small faults into the package, one at a time, and counts those that its tests notice.

    python tests/nightly/mutate.py --sample 300              300 random faults in each room
    python tests/nightly/mutate.py density optim --seed 7    all faults in two rooms

Each room is a part of the package with its own tests; only these are run. A test notices a fault
by failing, or by running three times as long as without it. The faults are mutmut's (see
mutation/mutants.py); those that change nothing that can be observed are named, with the reason, in
mutation/equivalents.py. Needs the extra "nightly" and a Linux system. The exit code is 1 where a
room's tests notice less than 90% of the faults.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from queue import SimpleQueue

from mutation.equivalents import EQUIVALENTS
from mutation.mutants import Mutant, mutants_of
from mutation.runner import PACKAGE, Coverage, Outcome, Runner

REQUIRED = 0.9


@dataclass(frozen=True)
class Room:
    """Source files (patterns in the package) and the tests that are responsible for them."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


_OPS = (
    "adam_step",
    "fuzz",
    "neighbours",
    "photometric",
    "project",
    "rasterize",
    "statistic",
    "tiling",
)
ROOMS = {
    "density": Room(("training/density/*.py",), ("tests/training/density",)),
    "optim": Room(
        ("training/optim.py", "training/lr_schedule.py"),
        ("tests/training/test_optim.py", "tests/training/test_lr_schedule.py"),
    ),
    "config": Room(("training/config.py",), ("tests/training/test_config.py",)),
    "losses": Room(("training/losses.py",), ("tests/training/test_losses.py",)),
    "trainer": Room(
        tuple(f"training/{name}.py" for name in ("trainer", "step_runner", "view_gradient")),
        ("tests/training/test_trainer.py", "tests/training/test_step_runner.py"),
    ),
    "scene": Room(("scene/*.py",), ("tests/scene",)),
    "trajectory": Room(("trajectory/*.py",), ("tests/trajectory",)),
    "reference": Room(("ops/reference.py",), tuple(f"tests/ops/test_{op}.py" for op in _OPS)),
    "data": Room(("data/**/*.py",), ("tests/data",)),
    "formats": Room(("formats/*.py",), ("tests/formats",)),
}


@dataclass
class Tally:
    """What became of the faults of a room."""

    total: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def tried(self) -> int:
        return sum(self.counts.values()) - self.counts["equivalent"]

    @property
    def share(self) -> float:
        """Of the faults that were tried, those that were noticed."""
        return 1 - self.counts["survived"] / self.tried if self.tried else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rooms", nargs="*", choices=[*ROOMS, []], help="default: all")
    parser.add_argument("--sample", type=int, help="random faults in each room (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of the samples (default: 0)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (default: 1)")
    flags = parser.parse_args()
    tallies = {}
    stale = 0
    for name in flags.rooms or ROOMS:
        mutants = [
            mutant
            for pattern in ROOMS[name].sources
            for path in sorted(PACKAGE.glob(pattern))
            for mutant in mutants_of(str(path.relative_to(PACKAGE)), path.read_bytes())
        ]
        stale += report_stale(mutants)
        chosen = mutants
        if flags.sample is not None and flags.sample < len(mutants):
            chosen = random.Random(f"{flags.seed} {name}").sample(mutants, flags.sample)
        tallies[name] = Tally(len(mutants))
        started = time.monotonic()
        outcomes = try_all(ROOMS[name], chosen, flags.jobs)
        for i, (mutant, outcome) in enumerate(outcomes, 1):
            tallies[name].counts[outcome.outcome] += 1
            if i % 25 == 0:
                print(f"{name}: {i} of {len(chosen)}", flush=True)
            if outcome.outcome == "survived":
                print(f"SURVIVED {mutant.diff()}", flush=True)
        print(
            f"{name}: {100 * tallies[name].share:.1f}% noticed of {tallies[name].tried} faults, "
            f"{time.monotonic() - started:.0f} s",
            flush=True,
        )
    print_table(tallies, flags.seed)
    return 1 if stale or any(tally.share < REQUIRED for tally in tallies.values()) else 0


def report_stale(mutants: list[Mutant]) -> int:
    """Prints the entries of mutation/equivalents.py that are none of these; their number."""
    files = {mutant.file for mutant in mutants}
    known = {(mutant.file, mutant.was, mutant.becomes) for mutant in mutants}
    stale = [key for key in EQUIVALENTS if key[0] in files and key not in known]
    for file, was, becomes in stale:
        print(f"STALE in mutation/equivalents.py: {file}\n  - {was}\n  + {becomes}", flush=True)
    return len(stale)


def try_all(room: Room, mutants: list[Mutant], jobs: int) -> Iterator[tuple[Mutant, Outcome]]:
    """Each mutant with what became of it, as they end."""
    unknown = []
    for mutant in mutants:
        if (mutant.file, mutant.was, mutant.becomes) in EQUIVALENTS:
            yield mutant, Outcome("equivalent", None, 0.0)
        else:
            unknown.append(mutant)
    if not unknown:
        return
    free: SimpleQueue[Runner] = SimpleQueue()
    runners = [Runner() for _ in range(jobs)]
    try:
        coverage = runners[0].coverage(room.tests)
        for runner in runners:
            free.put(runner)
        with ThreadPoolExecutor(jobs) as pool:
            outcomes = pool.map(lambda mutant: _try(mutant, free, coverage), unknown)
            yield from zip(unknown, outcomes, strict=True)
    finally:
        for runner in runners:
            runner.close()


def _try(mutant: Mutant, free: SimpleQueue[Runner], coverage: Coverage) -> Outcome:
    runner = free.get()
    try:
        return runner.try_mutant(mutant, coverage)
    finally:
        free.put(runner)


def print_table(tallies: dict[str, Tally], seed: int) -> None:
    """One line a room."""
    kinds = ("noticed", "timed out", "crashed", "survived", "equivalent")
    heads = "".join(f"{kind:>11}" for kind in kinds)
    print(f"\n{'room':12}{'faults':>8}{heads}{'share':>8}   (seed {seed})")
    for name, tally in tallies.items():
        counts = "".join(f"{tally.counts[kind]:11}" for kind in kinds)
        print(f"{name:12}{tally.total:8}{counts}{100 * tally.share:7.1f}%")


if __name__ == "__main__":
    sys.exit(main())
