"""Runs tests on mutants: selects the tests that can detect a fault, and runs them."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mutation.mutants import Mutant

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fork_server import Process, Server

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "src" / "snowsplat"
_COPIED = ("src", "tests", "pyproject.toml")
_BASELINE_SECONDS = 1800
_ON_THE_CPU = "not emulated and not gpu"


class Broken(Exception):
    """The tests fail although there is no fault."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of the tests of a fault."""

    outcome: str  # "detected", "survived", "timed out", "crashed" or "equivalent"
    by: str | None  # the test that failed first
    seconds: float

    @property
    def detected(self) -> bool:
        return self.outcome != "survived"


@dataclass(frozen=True)
class Coverage:
    """The lines that the tests execute, measured in a run without a fault.

    Attributes:
        seconds: processor time of each test.
        lines: file -> line -> names of the tests that execute this line. The name "" means that
            the line is executed by an import or by a fixture that several tests share.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests_for(self, mutant: Mutant) -> list[str]:
        """The tests that can detect this mutant, the fastest first."""
        if mutant.lines is None:
            found = set(self.seconds)
        else:
            executed = self.lines.get(mutant.file, {})
            found = {test for line in mutant.lines for test in executed.get(line, [])}
            if "" in found:
                found = set(self.seconds)
        return sorted(found, key=lambda test: (self.seconds[test], test))


class Runner:
    """A copy of the checkout, and a process whose forks run the tests on this copy."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="snowsplat_mutation_"))
        self.root = self._folder / "checkout"
        self.package = self.root / "src" / "snowsplat"
        self.root.mkdir()
        for path in ROOT.iterdir():
            if path.name in _COPIED and path.is_dir():
                ignored = shutil.ignore_patterns("__pycache__", "node_modules", "_viewer")
                shutil.copytree(path, self.root / path.name, ignore=ignored)
            elif path.name in _COPIED:
                shutil.copy(path, self.root)
            elif path.name not in ("build", ".git"):
                (self.root / path.name).symlink_to(path)
        (self.package / "_viewer").symlink_to(PACKAGE / "_viewer")
        # Real scenes and datasets are stored beside the checkout. Tests that do not find them are
        # skipped.
        if (ROOT.parent / "shared").exists():
            (self._folder / "shared").symlink_to(ROOT.parent / "shared")
        environment = os.environ | {
            "PYTHONPATH": str(self.package.parent),
            "OMP_NUM_THREADS": "1",
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self._folder / "hypothesis"),
        }
        self._environment = environment
        self._server = Server("import_libraries", environment)

    def close(self) -> None:
        """End the process and remove the copy."""
        self._server.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def coverage(self, tests: Sequence[str]) -> Coverage:
        """Run the tests without a fault.

        Raises:
            Broken: a test fails.
        """
        path = self._folder / "coverage.json"
        outcome = self.run(
            tests, cpu_seconds=_BASELINE_SECONDS, seconds=_BASELINE_SECONDS, coverage=str(path)
        )
        if outcome.detected:
            raise Broken(f"{' '.join(tests)}: {outcome.outcome} without a fault: {outcome.by}")
        found = json.loads(path.read_text())
        lines = {
            file: {int(line): names for line, names in of_file.items()}
            for file, of_file in found["lines"].items()
        }
        return Coverage(found["seconds"], lines)

    def try_mutant(self, mutant: Mutant, coverage: Coverage) -> Outcome:
        """Run the tests that can detect the mutant, until one of them fails."""
        order = coverage.tests_for(mutant)
        if not order:
            return Outcome("survived", None, 0.0)
        expected = sum(coverage.seconds[test] for test in order)
        path = self.package / mutant.file
        source = path.read_bytes()
        cached = path.parent.glob(f"__pycache__/{path.stem}.*")
        try:
            path.write_bytes(mutant.source)
            for file in cached:
                file.unlink()
            return self.run(
                sorted({test.partition("::")[0] for test in order}),
                order=order,
                cpu_seconds=int(3 * expected) + 15,
                seconds=20 * expected + 120,
            )
        finally:
            path.write_bytes(source)

    def run(
        self,
        tests: Sequence[str],
        *,
        cpu_seconds: int,
        seconds: float,
        order: Sequence[str] | None = None,
        marked: str = _ON_THE_CPU,
        isa: str | None = None,
        coverage: str | None = None,
    ) -> Outcome:
        """Run tests until one fails; see run_tests.py.

        Args:
            tests: files and folders.
            cpu_seconds, seconds: limits of the processor time and of the wall time.
            order: the names of the tests to run, in this order; default: all.
            marked: the value of pytest's option ``-m``.
            isa: the instruction set; default: the best one.
            coverage: file to which the executed lines are written; if set, all tests run, even if
                one fails.
        """
        temporary, outcome = self._folder / "temporary", self._folder / "outcome.json"
        run = {
            "tests": list(tests),
            "order": order,
            "marked": marked,
            "isa": isa,
            "cpu_seconds": cpu_seconds,
            "temporary": str(temporary),
            "outcome": str(outcome),
            "coverage": coverage,
        }
        (self._folder / "run.json").write_text(json.dumps(run))
        outcome.unlink(missing_ok=True)
        request = {
            "argv": [str(Path(__file__).with_name("run_tests.py")), str(self._folder / "run.json")],
            "env": self._environment,
            "cwd": str(self.root),
            "forks": False,
            "group": True,
        }
        null = subprocess.DEVNULL
        start, in_time = time.monotonic(), True
        process = Process(self._server, request, null, null, null)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            in_time = False
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)  # also the processes that the tests have started
        code = process.wait()
        shutil.rmtree(temporary, ignore_errors=True)
        found = {"outcome": "crashed", "by": None}
        if outcome.exists():
            found = json.loads(outcome.read_text())
        elif not in_time or code in (-signal.SIGXCPU, -signal.SIGKILL):
            found["outcome"] = "timed out"
        return Outcome(**found, seconds=time.monotonic() - start)
