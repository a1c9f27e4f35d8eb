"""Runs pytest: ``run_tests.py RUN``, in a fork of a process that has imported torch; see `runner`.

RUN is a file with a JSON object, which has these keys:

    tests                   files and folders of tests
    order                   names of the tests to run, in this order; null: all
    marked                  the value of pytest's option -m
    isa                     the instruction set; null: the best one
    cpu_seconds             a limit of the processor time
    temporary               a folder for temporary files
    outcome                 the file for the outcome
    coverage                a file for the executed lines; null: stop at the first failure instead
"""

import json
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

_MOST_MEMORY = 12 << 30  # bytes of address space; torch alone uses a few GiB


class _Plugin:
    """Runs the tests in the given order; records the first failed test and all times."""

    def __init__(self, order: list[str] | None, recorded: coverage.Coverage | None) -> None:
        self.order = order
        self.recorded = recorded
        self.failed: str | None = None
        self.seconds: dict[str, float] = {}
        self.skipped: set[str] = set()
        self.context = ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if self.order is None:
            return
        by_name = {item.nodeid: item for item in items}
        # If a fault has changed the names of tests, all tests run.
        if all(name in by_name for name in self.order):
            items[:] = [by_name[name] for name in self.order]

    def _switch(self, context: str) -> None:
        self.context = context
        if self.recorded is not None:
            self.recorded.switch_context(context)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._switch(item.nodeid)
        start = _cpu_seconds()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = _cpu_seconds() - start
            self._switch("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef) -> Iterator[None]:
        """Record the lines of a fixture that several tests share under the name ""."""
        context = self.context
        if fixturedef.scope != "function":
            self._switch("")
        try:
            return (yield)
        finally:
            self._switch(context)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and self.failed is None:
            self.failed = report.nodeid
        if report.skipped:
            self.skipped.add(report.nodeid)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed and self.failed is None:
            self.failed = report.nodeid


def _cpu_seconds() -> float:
    """Processor time of this process, and of its child processes that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _run(run: dict) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (run["cpu_seconds"], run["cpu_seconds"] + 1))
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if run["isa"]:
        os.environ["SNOWSPLAT_ISA"] = run["isa"]
    # Python compares the size and the modification time (in seconds) of a source file with those
    # in its .pyc file. A fault may change neither, so no .pyc files are written.
    sys.dont_write_bytecode = run["coverage"] is None
    recorded = None
    if run["coverage"]:
        recorded = coverage.Coverage(data_file=None, config_file=False, source_pkgs=["snowsplat"])
        recorded.start()
    plugin = _Plugin(run["order"], recorded)
    options = ["-p", "no:cacheprovider", "--basetemp", run["temporary"]]
    options += ["-m", run["marked"]]
    options += [] if run["coverage"] else ["-x"]
    code = pytest.main([*run["tests"], *options], plugins=[plugin])
    if recorded is not None:
        recorded.stop()
        _write_coverage(Path(run["coverage"]), plugin, recorded.get_data())
    passed = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    outcome = "survived" if code in passed else "detected"
    Path(run["outcome"]).write_text(json.dumps({"outcome": outcome, "by": plugin.failed}))


def _write_coverage(path: Path, plugin: _Plugin, data: coverage.CoverageData) -> None:
    """Write {"seconds": {test: processor time}, "lines": {file: {line: [tests]}}}."""
    ran = {name: s for name, s in plugin.seconds.items() if name not in plugin.skipped}
    lines = {
        os.path.relpath(file, os.path.join(os.environ["PYTHONPATH"], "snowsplat")): {
            line: [test for test in tests if test in ran or not test]
            for line, tests in data.contexts_by_lineno(file).items()
        }
        for file in data.measured_files()
    }
    path.write_text(json.dumps({"seconds": ran, "lines": lines}))


if __name__ == "__main__":
    try:
        _run(json.loads(Path(sys.argv[1]).read_text()))
    finally:
        os._exit(0)  # without an outcome, the run has crashed
