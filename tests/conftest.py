"""Shared by all tests: a dataset, signals, threads of parallel processes, and automatic marks.

`make quick` leaves out the marks sfm, browser, build, emulated, kill, slow and gpu; pyproject.toml
describes them.
"""

import gc
import logging
import os
import signal
from collections.abc import Generator
from pathlib import Path

import pytest

# A shell starts background jobs with Ctrl-C ignored, and their children inherit that. Tests
# that send it need it to work, here and in the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# It protects files from a loss of power only, and a disk may take 20 ms for each of them.
os.fsync = lambda handle: None

if "PYTEST_XDIST_WORKER" in os.environ:
    # There is one process per core. Torch's threads spin while they wait, so several threads per
    # process would compete for the cores. The variable is set before torch is imported. Results
    # do not depend on it.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

_HERE = Path(__file__).parent
#: Marks set by the folder of a test, and by the fixtures that it uses.
#: Tests of `cli`, `pipeline`, `studio` and `viewer` train, serve or render; those of the parser are
#: quick.
_OF_FOLDERS = {
    "kill": "kill",
    "fuzz": "slow",
    "cli": "slow",
    "pipeline": "slow",
    "studio": "slow",
    "viewer": "slow",
}
_QUICK = {"cli/test_main.py"}
_OF_FIXTURES = {"recorder": "build", "start": "slow"}


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    """A folder of 9 views, 48×36; read-only for the tests."""
    from snowsplat.synthetic.toy_dataset import write_toy_dataset

    root = tmp_path_factory.mktemp("shared")
    return write_toy_dataset(root / "dataset", "colmap-bin", 9, 48, 36, n_points=300)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        path = item.path.relative_to(_HERE)
        folder = path.parts[0]
        if folder in _OF_FOLDERS and path.as_posix() not in _QUICK:
            item.add_marker(_OF_FOLDERS[folder])
        for fixture in _OF_FIXTURES.keys() & getattr(item, "fixturenames", ()):
            item.add_marker(_OF_FIXTURES[fixture])
    # The tests of a page share a browser and a training run. At the end of the tests, a second
    # process would take over some of them.
    # The driver that computes WebGPU on the CPU contains LLVM, and so does a part of torch: after a
    # test on webgpu, a process cannot load the other one.
    marks = {item: {mark.name for mark in item.iter_markers()} for item in items}
    items.sort(key=lambda item: ("webgpu" in marks[item], "browser" not in marks[item]))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    # The objects of 10,000 tests stay: examining them again and again takes a sixth of this time.
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish(session: pytest.Session) -> None:
    if any(item.get_closest_marker("webgpu") for item in session.items):
        from snowsplat.ops.webgpu import backend

        if backend.why_unsupported() is None:
            backend.enable()  # before the first backward pass
    # Each training run calls gc.collect(), which need not examine the loaded modules and all tests.
    gc.collect()
    gc.freeze()
    # For each phase of a test, pytest adds its handlers to each logger that does not propagate to
    # the root logger. Torch has more than 40 of them.
    for name, logger in logging.root.manager.loggerDict.items():
        if name.split(".")[0] == "torch" and isinstance(logger, logging.Logger):
            logger.propagate = True


def pytest_sessionstart() -> None:
    """With SNOWSPLAT_NEON, the kernels for Arm replace those of this machine: `make neon`."""
    if os.environ.get("SNOWSPLAT_NEON"):
        from snowsplat.ops.native import LAUNCHERS
        from snowsplat.util import native_library

        from .ops import neon

        LAUNCHERS["cpu"] = native_library.call = neon.launch


def pytest_runtest_setup(item: pytest.Item) -> None:
    from .browser import chromium
    from .usd import USD

    given = item.callspec.params.values() if hasattr(item, "callspec") else ()
    names = {each if isinstance(each, str) else getattr(each, "name", None) for each in given}
    if names & {".usd", "USD"} and not USD:
        pytest.skip("needs usd-core 26.3 or newer (pip install 'snowsplat[usd]')")

    if item.get_closest_marker("browser") and chromium() is None:
        pytest.skip(
            "needs Chromium (apt install chromium), or its path in the variable SNOWSPLAT_CHROMIUM"
        )
