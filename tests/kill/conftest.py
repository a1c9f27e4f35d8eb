"""Small inputs, and what starts commands; see `harness`."""

import sys
from pathlib import Path

import pytest

from ..fork_server import popen
from ..sfm.colmap import scenes
from .harness import Runner

if sys.platform != "linux":
    collect_ignore = ["test_kills.py", "test_pressure.py"]  # fork, process groups, mounts


@pytest.fixture(scope="session")
def photos(tmp_path_factory) -> Path:
    """6 photos, 320×240; read-only for the tests."""
    return scenes.write_photos(tmp_path_factory.mktemp("kill") / "photos", 6)


@pytest.fixture(scope="session")
def runner(tmp_path_factory) -> Runner:
    return Runner(tmp_path_factory.mktemp("runner"), popen)
