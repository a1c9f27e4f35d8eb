"""Mutation testing of the kernels: counts the artificial faults that the tests detect.

    python tests/nightly/mutate_kernels.py                    all faults
    python tests/nightly/mutate_kernels.py --only cpu/ ssim   faults with this in file or text

The faults are written by hand, in mutation/kernel_faults.toml. The script puts them into a copy of
the checkout, one at a time. A fault in a header or in native/cpu/ is compiled for the baseline
instruction set. A fault in native/cuda/ is compiled by the emulation of the tests. Then the tests
of the operation run until one fails. The script needs the extra "nightly", a Linux system and a C++
compiler. The exit code is 1 if less than 90% of the faults are detected, or if an entry does not
match the sources.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from mutation.runner import Broken, Outcome, Runner
from mutation.tables import FAULTS, Fault

REQUIRED = 0.9
# Less optimisation than in the package, because compiling would take longer than the tests.
_FLAGS = [
    *("-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-pthread"),
    *("-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"),
    "-DSNOWSPLAT_ISA_BASELINE=1",
]
_MOST_CPU_SECONDS = 900


class Kernels:
    """The native sources of a copy of the checkout, and how they are compiled."""

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        self.native = runner.package / "native"
        self._compiler = os.environ.get("CXX", "c++")
        self._objects = runner.root / "build" / "objects"
        self._objects.mkdir(parents=True)
        # The tests must use only the library that is compiled here.
        for library in (runner.package / "_lib").glob("*.so"):
            library.unlink()
        self._compile(sorted(self.native.glob("cpu/*.cpp")))
        self._link()

    def try_fault(self, fault: Fault) -> Outcome | None:
        """The outcome of a fault; None if its text does not occur exactly once."""
        path = self.native / fault.file
        source = path.read_text()
        if source.count(fault.was) != 1:
            return None
        on_gpu = fault.file.startswith("cuda/")
        dependent = [] if on_gpu else self._dependent(path)
        objects = {file: self._object(file).read_bytes() for file in dependent}
        try:
            path.write_text(source.replace(fault.was, fault.becomes))
            self._compile(dependent)
            self._link()
            return self.run_tests(fault)
        finally:
            path.write_text(source)
            for file, content in objects.items():
                self._object(file).write_bytes(content)
            self._link()

    def run_tests(self, fault: Fault) -> Outcome:
        """Run the tests that must detect a fault, with the current sources."""
        return self.runner.run(
            [f"tests/ops/test_{fault.tests}.py"],
            marked="emulated" if fault.file.startswith("cuda/") else "not emulated and not gpu",
            isa="baseline",
            cpu_seconds=_MOST_CPU_SECONDS,
            seconds=4 * _MOST_CPU_SECONDS,
        )

    def _object(self, source: Path) -> Path:
        return self._objects / f"{source.stem}.o"

    def _dependent(self, changed: Path) -> list[Path]:
        """The source files that must be compiled again if a file changes."""
        return [
            source
            for source in sorted(self.native.glob("cpu/*.cpp"))
            if str(changed) in self._object(source).with_suffix(".d").read_text()
        ]

    def _compile(self, sources: list[Path]) -> None:
        for source in sources:
            command = [self._compiler, *_FLAGS, f"-I{self.native}", "-MD", "-c", source]
            subprocess.run([*command, "-o", self._object(source)], check=True)

    def _link(self) -> None:
        library = self.runner.package / "_lib" / "libsnowsplat_baseline.so"
        # The old file is removed and not overwritten, because a process may have loaded it.
        library.unlink(missing_ok=True)
        objects = sorted(self._objects.glob("*.o"))
        subprocess.run([self._compiler, "-shared", "-pthread", *objects, "-o", library], check=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[""], help="parts of files or texts")
    flags = parser.parse_args()
    chosen = [
        fault
        for fault in FAULTS
        if any(part in f"{fault.file} {fault.was} {fault.breaks}" for part in flags.only)
    ]
    runner = Runner()
    detected = survived = stale = 0
    try:
        kernels = Kernels(runner)
        passing: set[tuple[str, bool]] = set()
        for fault in chosen:
            tests = fault.tests, fault.file.startswith("cuda/")
            if tests not in passing:
                outcome = kernels.run_tests(fault)
                if outcome.detected:
                    raise Broken(f"{fault.tests}: {outcome.outcome} without a fault: {outcome.by}")
                passing.add(tests)
            name = f"{fault.file}: {fault.breaks}"
            started = time.monotonic()
            tried = kernels.try_fault(fault)
            took = f"{time.monotonic() - started:.0f} s"
            if tried is None:
                stale += 1
                print(f"STALE     {name}: {fault.was!r} does not occur exactly once", flush=True)
            elif tried.detected:
                detected += 1
                print(f"detected  {name}, {tried.by or tried.outcome}, {took}", flush=True)
            else:
                survived += 1
                print(f"SURVIVED  {name}, {took}", flush=True)
    finally:
        runner.close()
    count = detected + survived
    share = detected / count if count else 1.0
    print(f"{detected} of {count} faults detected ({100 * share:.1f}%), {stale} stale")
    return 1 if stale or share < REQUIRED else 0


if __name__ == "__main__":
    sys.exit(main())
