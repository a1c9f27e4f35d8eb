"""Trial reading in a child process: limits of memory and time, crashes, and errors in one line."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from snowsplat.util import limited_child, messages
from snowsplat.util.errors import UserError
from snowsplat.util.limited_child import check_readable


def read(path: Path) -> bytes:
    return path.read_bytes()


def fill_memory(path: Path) -> None:
    kept = []
    while True:
        kept.append(bytes([1]) * (1 << 24))
        time.sleep(0.01)  # others have their turn, as in a library that gives up Python's lock


def never_end(path: Path) -> None:
    while True:
        pass


def wait_forever(path: Path) -> None:
    signal.pause()


def crash(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def refuse(path: Path) -> None:
    raise UserError("{path}: is a file; use a folder", path=path)


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setattr(limited_child, "_SECONDS", 1.0)
    monkeypatch.setattr(limited_child, "_WAITING", 3)
    (tmp_path / "a.bin").write_bytes(b"x" * 100)
    return tmp_path / "a.bin"


@pytest.mark.parametrize("reader", [fill_memory, never_end, wait_forever, crash])
def test_a_reader_that_is_ended(file, reader):
    with pytest.raises(UserError, match=r"a.bin: is damaged or too large: .* memory or time"):
        check_readable(reader, file, ["json"])


def test_a_reader_that_returns(file):
    check_readable(read, file, [])
    check_readable(read, file, ["json", "zlib"])


def test_what_a_reader_says(file):
    """As a message, which has its Chinese."""
    with pytest.raises(UserError) as refused:
        check_readable(refuse, file, [])
    assert refused.value.message == messages.message("{path}: is a file; use a folder", path=file)


def test_memory_where_the_system_does_not_limit_it(file):
    code = (
        "import sys; sys.platform = 'darwin'; import runpy;"
        "runpy.run_module('snowsplat.util.limited_child', run_name='__main__')"
    )
    words = [__name__, "fill_memory", str(file), str(1 << 28), "9"]
    ended = subprocess.run(
        [sys.executable, "-c", code, *words],
        env=limited_child.child_environment(1),
        capture_output=True,
    )
    assert (ended.returncode, ended.stderr) == (1, b"")
