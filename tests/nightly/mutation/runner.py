"""Runs tests on mutants: which of a room's tests can notice a fault, and whether one does."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mutation.mutants import Mutant

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "src" / "snowsplat"
#: What faults are not put into: linked into a copy of the package, not copied.
_LINKED = ("_lib", "_viewer", "native")
_BASELINE_SECONDS = 1800


class Broken(Exception):
    """The tests fail without a fault."""


@dataclass(frozen=True)
class Outcome:
    """What became of a fault: "noticed", "survived", "timed out" or "crashed", and the test that
    failed first."""

    outcome: str
    by: str | None
    seconds: float

    @property
    def noticed(self) -> bool:
        return self.outcome != "survived"


@dataclass(frozen=True)
class Coverage:
    """What a run of the tests without a fault executes.

    Attributes:
        seconds: time of the processor of each test.
        lines: the tests that execute each line of each file; "" stands for what is executed by
            imports and by fixtures of several tests.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests_for(self, mutant: Mutant) -> list[str]:
        """Those that can notice it, the fastest first."""
        if mutant.lines is None:
            found = set(self.seconds)
        else:
            executed = self.lines.get(mutant.file, {})
            found = {test for line in mutant.lines for test in executed.get(line, [])}
            if "" in found:
                found = set(self.seconds)
        return sorted(found, key=lambda test: (self.seconds[test], test))


class Runner:
    """A copy of the package, and a process in whose forks the tests run on it."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="snowsplat_mutation_"))
        package = self._folder / "src" / "snowsplat"
        ignored = shutil.ignore_patterns("__pycache__", *_LINKED)
        shutil.copytree(PACKAGE, package, ignore=ignored)
        for name in _LINKED:
            if (PACKAGE / name).exists():
                (package / name).symlink_to(PACKAGE / name)
        self._package = package
        environment = os.environ | {
            "PYTHONPATH": str(package.parent),
            "OMP_NUM_THREADS": "1",
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self._folder / "hypothesis"),
        }
        self._process = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("zygote.py")],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def close(self) -> None:
        """Ends the process and removes the copy."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def coverage(self, tests: Sequence[str]) -> Coverage:
        """Runs the tests without a fault.

        Raises:
            Broken: a test fails.
        """
        path = self._folder / "coverage.json"
        limits = {"cpu_seconds": _BASELINE_SECONDS, "seconds": _BASELINE_SECONDS}
        outcome = self._run(tests=tests, order=None, coverage=str(path), **limits)
        if outcome.noticed:
            raise Broken(f"{' '.join(tests)}: {outcome.outcome} without a fault: {outcome.by}")
        found = json.loads(path.read_text())
        lines = {
            file: {int(line): names for line, names in of_file.items()}
            for file, of_file in found["lines"].items()
        }
        return Coverage(found["seconds"], lines)

    def try_mutant(self, mutant: Mutant, coverage: Coverage) -> Outcome:
        """Runs the tests that can notice it, until one does."""
        order = coverage.tests_for(mutant)
        if not order:
            return Outcome("survived", None, 0.0)
        expected = sum(coverage.seconds[test] for test in order)
        path = self._package / mutant.file
        source = path.read_bytes()
        cached = path.parent.glob(f"__pycache__/{path.stem}.*")
        try:
            path.write_bytes(mutant.source)
            for file in cached:
                file.unlink()
            return self._run(
                tests=sorted({test.partition("::")[0] for test in order}),
                order=order,
                coverage=None,
                cpu_seconds=int(3 * expected) + 15,
                seconds=20 * expected + 120,
            )
        finally:
            path.write_bytes(source)

    def _run(self, **run: object) -> Outcome:
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        temporary = self._folder / "temporary"
        process.stdin.write(json.dumps(run | {"temporary": str(temporary)}) + "\n")
        process.stdin.flush()
        answer = json.loads(process.stdout.readline())
        shutil.rmtree(temporary, ignore_errors=True)
        return Outcome(**answer)
