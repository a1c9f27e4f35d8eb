"""Claims: one process at a time, and claims of processes that have ended."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time

import pytest

from snowsplat.util.claims import claimed


def test_claims(tmp_path):
    file = tmp_path / "scene.claim"
    with claimed(file) as first:
        assert first
        assert file.read_text(encoding="utf-8").split()[1] == str(os.getpid())
        begin = time.monotonic()
        with claimed(file, wait=0.3) as second:
            assert not second
        assert time.monotonic() - begin >= 0.3
        assert file.exists()  # who has no claim removes none
    assert not file.exists()


@pytest.mark.parametrize(
    ("host", "age", "free"),
    [
        (socket.gethostname(), 0, True),  # the process has ended
        ("elsewhere", 0, False),
        ("elsewhere", 1000, True),  # not renewed for a long time
    ],
)
def test_claims_of_others(tmp_path, host, age, free):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    file = tmp_path / "scene.claim"
    file.write_text(f"{host} {ended.pid}", encoding="utf-8")
    then = time.time() - age
    os.utime(file, (then, then))
    with claimed(file) as is_ours:
        assert is_ours == free
    assert file.exists() != free
    assert len(list(tmp_path.iterdir())) == (0 if free else 1)
