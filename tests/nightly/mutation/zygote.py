"""Runs pytest in forks of a process that has imported torch, because the import takes long.

    python zygote.py      one line of JSON per run on stdin, one line with the outcome on stdout

A run is a JSON object with these keys:

    tests                   files and folders of tests
    order                   names of the tests to run, in this order; null: all
    marked                  the value of pytest's option -m
    isa                     the instruction set; null: the best one
    cpu_seconds, seconds    limits of the processor time and of the wall time
    temporary               a folder for temporary files
    coverage                a file for the executed lines; null: stop at the first failure instead

The package itself is imported after the fork, because it is different in each run.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import io
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

_IMPORTS = ("torch", "numpy", "PIL.Image", "hypothesis", "safetensors.torch", "zstandard", "rich")
_MOST_MEMORY = 12 << 30  # bytes of address space; torch alone uses a few GiB
_CRASHED, _SURVIVED, _DETECTED = "crashed", "survived", "detected"
_TIMED_OUT = "timed out"


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


def _child(run: dict, answer: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (run["cpu_seconds"], run["cpu_seconds"] + 1))
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if run["isa"]:
        os.environ["SNOWSPLAT_ISA"] = run["isa"]
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
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
    outcome = _SURVIVED if code in passed else _DETECTED
    os.write(answer, json.dumps({"outcome": outcome, "by": plugin.failed}).encode())


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


def _run(run: dict) -> dict:
    reading, writing = os.pipe()
    start = time.monotonic()
    pid = os.fork()
    if pid == 0:
        try:
            os.setpgid(0, 0)
            os.close(reading)
            _child(run, writing)
        finally:
            os._exit(0)
    os.close(writing)
    handle = os.pidfd_open(pid)
    in_time = bool(select.select([handle], [], [], run["seconds"])[0])
    os.close(handle)
    with contextlib.suppress(OSError):
        os.killpg(pid, signal.SIGKILL)  # also the processes that the tests have started
    _, status = os.waitpid(pid, 0)
    with os.fdopen(reading, "rb") as pipe:
        text = pipe.read()
    if text:
        outcome = json.loads(text)
    elif not in_time or os.waitstatus_to_exitcode(status) in (-signal.SIGXCPU, -signal.SIGKILL):
        outcome = {"outcome": _TIMED_OUT, "by": None}
    else:
        outcome = {"outcome": _CRASHED, "by": None}
    return outcome | {"seconds": time.monotonic() - start}


def serve() -> None:
    """Execute runs until stdin is closed."""
    for name in _IMPORTS:
        importlib.import_module(name)
    with contextlib.redirect_stdout(io.StringIO()):
        pytest.main(["--version"])  # imports its plugins
    gc.collect()
    # pytest collects garbage at the end of a run. The objects that exist now are excluded.
    gc.freeze()
    # Linux ends this process if its parent ends (1 is PR_SET_PDEATHSIG).
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    for line in sys.stdin:
        print(json.dumps(_run(json.loads(line))), flush=True)


if __name__ == "__main__":
    serve()
