"""Mutation testing of the Python code: counts the artificial faults that the tests detect.

    python tests/nightly/mutate.py --sample 300              300 random faults in each part
    python tests/nightly/mutate.py density optim --seed 7    all faults in two parts

The script puts small faults into the package, one at a time. The package is divided into parts, and
each part has its own tests: only these run for a fault in the part. A test detects a fault if it
fails, or if it takes three times as long as without the fault. The faults are made by the operators
of mutmut, see mutation/mutants.py. Some faults have no observable effect; mutation/equivalents.toml
lists them, with the reason for each. The script needs the extra "nightly" and a Linux system. The
exit code is 1 if the tests of a part detect less than 90% of the faults in it.
"""

import argparse
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

from mutation.mutants import Mutant, mutants_of
from mutation.runner import PACKAGE, Coverage, Outcome, Runner
from mutation.tables import EQUIVALENTS

REQUIRED = 0.9


@dataclass(frozen=True)
class Part:
    """Source files (as patterns in the package), and the tests that must detect faults in them."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


_OPS = (
    "adam_step",
    "fuzz",
    "neighbours",
    "photometric",
    "plane_sweep",
    "project",
    "rasterize",
    "statistic",
    "tiling",
)
PARTS = {
    "density": Part(("training/density/*.py",), ("tests/training/density",)),
    "optim": Part(
        ("training/step/optim.py", "training/settings/rates.py"),
        ("tests/training/test_optim.py", "tests/training/test_schedule.py"),
    ),
    "settings": Part(
        ("training/settings/*.py",),
        tuple(f"tests/training/test_{name}.py" for name in ("settings", "recipes", "parts")),
    ),
    "losses": Part(("training/step/losses.py",), ("tests/training/test_losses.py",)),
    "trainer": Part(
        (
            "training/core/trainer.py",
            "training/step/step_runner.py",
            "training/step/view_gradient.py",
        ),
        ("tests/training/test_trainer.py", "tests/training/test_step_runner.py"),
    ),
    "scene": Part(("scene/*.py",), ("tests/scene",)),
    "trajectory": Part(("trajectory/*.py",), ("tests/trajectory",)),
    "reference": Part(("ops/*reference.py",), tuple(f"tests/ops/test_{op}.py" for op in _OPS)),
    "data": Part(("data/**/*.py",), ("tests/data", "tests/fuzz")),
    "formats": Part(("formats/*.py",), ("tests/formats", "tests/fuzz")),
}


@dataclass
class Tally:
    """The outcomes of the faults in a part."""

    total: int = 0  # number of faults, also those that were not tried
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def tried(self) -> int:
        return sum(self.counts.values()) - self.counts["equivalent"]

    @property
    def share(self) -> float:
        """The fraction of the tried faults that was detected."""
        return 1 - self.counts["survived"] / self.tried if self.tried else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--sample", type=int, help="random faults in each part (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of the samples (default: 0)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (default: 1)")
    flags = parser.parse_args()
    tallies = {}
    stale = 0
    for name in flags.parts or PARTS:
        paths = files_of(name)
        mutants = [
            mutant
            for path in paths
            for mutant in mutants_of(str(path.relative_to(PACKAGE)), path.read_bytes())
        ]
        stale += report_stale(mutants)
        chosen = mutants
        if flags.sample is not None and flags.sample < len(mutants):
            chosen = random.Random(f"{flags.seed} {name}").sample(mutants, flags.sample)
        tallies[name] = Tally(len(mutants))
        started = time.monotonic()
        outcomes = try_all(PARTS[name], chosen, flags.jobs)
        for i, (mutant, outcome) in enumerate(outcomes, 1):
            tallies[name].counts[outcome.outcome] += 1
            if i % 25 == 0:
                print(f"{name}: {i} of {len(chosen)}", flush=True)
            if outcome.outcome == "survived":
                print(f"SURVIVED {mutant.diff()}", flush=True)
        print(
            f"{name}: {100 * tallies[name].share:.1f}% of {tallies[name].tried} faults detected, "
            f"{time.monotonic() - started:.0f} s",
            flush=True,
        )
    print_table(tallies, flags.seed)
    return 1 if stale or any(tally.share < REQUIRED for tally in tallies.values()) else 0


def files_of(name: str) -> list[Path]:
    """The source files of a part. Files that have been moved are an error, also among its tests."""
    part = PARTS[name]
    found = {pattern: sorted(PACKAGE.glob(pattern)) for pattern in part.sources}
    lost = [pattern for pattern, paths in found.items() if not paths]
    lost += [test for test in part.tests if not (PACKAGE.parents[1] / test).exists()]
    if lost:
        sys.exit(f"mutate: {', '.join(lost)} does not exist; change PARTS")
    return [path for paths in found.values() for path in paths]


def report_stale(mutants: list[Mutant]) -> int:
    """Print the entries of mutation/equivalents.toml that match no mutant; returns their number."""
    files = {mutant.file for mutant in mutants}
    known = {(mutant.file, mutant.was, mutant.becomes) for mutant in mutants}
    stale = [key for key in EQUIVALENTS if key[0] in files and key not in known]
    for file, was, becomes in stale:
        print(f"STALE in mutation/equivalents.toml: {file}\n  - {was}\n  + {becomes}", flush=True)
    return len(stale)


def try_all(part: Part, mutants: list[Mutant], jobs: int) -> Iterator[tuple[Mutant, Outcome]]:
    """Yields each mutant and its outcome, as soon as it is known."""
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
        coverage = runners[0].coverage(part.tests)
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
    """Print one line per part."""
    kinds = ("detected", "timed out", "crashed", "survived", "equivalent")
    heads = "".join(f"{kind:>11}" for kind in kinds)
    print(f"\n{'part':12}{'faults':>8}{heads}{'share':>8}   (seed {seed})")
    for name, tally in tallies.items():
        counts = "".join(f"{tally.counts[kind]:11}" for kind in kinds)
        print(f"{name:12}{tally.total:8}{counts}{100 * tally.share:7.1f}%")


if __name__ == "__main__":
    sys.exit(main())
