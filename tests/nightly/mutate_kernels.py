"""Puts faults written by hand into the kernels, one at a time, and counts those that tests notice.

    python tests/nightly/mutate_kernels.py                    all
    python tests/nightly/mutate_kernels.py --only cpu/ ssim   those whose file or text contains this

Each fault (mutation/kernel_faults.py) is put into a copy of the checkout. A fault in a header or in
native/cpu/ is compiled for the baseline instruction set, one in native/cuda/ by the emulation of
the tests; then the tests of the operation run until one fails. Needs the extra "nightly", a Linux
system and a C++ compiler. The exit code is 1 if less than 90% are noticed, or if an entry does not
fit the sources.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from mutation.kernel_faults import FAULTS, Fault
from mutation.runner import Broken, Outcome, Runner

REQUIRED = 0.9
# Not optimised as in the package, since compiling would take longer than the tests.
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
        # What the tests use of the package's libraries is this one alone.
        for library in (runner.package / "_lib").glob("*.so"):
            library.unlink()
        self._compile(sorted(self.native.glob("cpu/*.cpp")))
        self._link()

    def try_fault(self, fault: Fault) -> Outcome | None:
        """What became of a fault; None if its text does not occur exactly once."""
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

    def run_tests(self, fault: Fault) -> Outcome:
        """Runs the tests that must notice a fault on the sources as they are."""
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
        """The sources whose objects depend on a file."""
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
        # A new file: the old one may be loaded.
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
    noticed = survived = stale = 0
    try:
        kernels = Kernels(runner)
        passing: set[tuple[str, bool]] = set()
        for fault in chosen:
            tests = fault.tests, fault.file.startswith("cuda/")
            if tests not in passing:
                outcome = kernels.run_tests(fault)
                if outcome.noticed:
                    raise Broken(f"{fault.tests}: {outcome.outcome} without a fault: {outcome.by}")
                passing.add(tests)
            name = f"{fault.file}: {fault.breaks}"
            started = time.monotonic()
            tried = kernels.try_fault(fault)
            took = f"{time.monotonic() - started:.0f} s"
            if tried is None:
                stale += 1
                print(f"STALE     {name}: {fault.was!r} does not occur exactly once", flush=True)
            elif tried.noticed:
                noticed += 1
                print(f"noticed   {name}, {tried.by or tried.outcome}, {took}", flush=True)
            else:
                survived += 1
                print(f"SURVIVED  {name}, {took}", flush=True)
    finally:
        runner.close()
    count = noticed + survived
    share = noticed / count if count else 1.0
    print(f"{noticed} of {count} faults noticed ({100 * share:.1f}%), {stale} stale")
    return 1 if stale or share < REQUIRED else 0


if __name__ == "__main__":
    sys.exit(main())
