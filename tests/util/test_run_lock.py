"""One run per folder: waiting, messages, killed processes, and holders on other computers."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time

import pytest

from snowsplat.util import run_lock
from snowsplat.util.errors import UserError
from snowsplat.util.run_lock import LOCK, InUse, is_locked, locked, one_run

_HOLD = """
import sys, time
from pathlib import Path
from snowsplat.util.run_lock import one_run
with one_run(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_one_run(tmp_path):
    folder = tmp_path / "new" / "out"
    with one_run(folder):
        begin = time.monotonic()
        who = rf"out: in use by process {os.getpid()} on {socket.gethostname()}, since \d"
        with pytest.raises(InUse, match=who), one_run(folder, wait=0.2):
            pass
        assert time.monotonic() - begin >= 0.2
        assert (folder / LOCK).exists()  # who has no lock removes none
        (folder / "result").touch()
    assert [path.name for path in folder.iterdir()] == ["result"]
    with one_run(tmp_path / "empty" / "out"):
        pass
    assert not (tmp_path / "empty").exists()
    with pytest.raises(UserError, match="is a file"), one_run(folder / "result"):
        pass


def test_a_killed_process_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline().strip() == b"held"
        refused = rf"process {holder.pid} on .*: -c "
        with pytest.raises(InUse, match=refused), one_run(tmp_path, wait=0):
            pass
        holder.kill()
        with one_run(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text("utf-8"))["process"] == os.getpid()


def test_a_lock_in_a_folder_to_look_at(tmp_path, monkeypatch):
    """As on a disk that is mounted to read only, or of another user."""
    lock = tmp_path / LOCK
    opened = os.open

    def refuse(path, flags, *more):
        if flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return opened(path, flags, *more)

    with one_run(tmp_path), monkeypatch.context() as patch:
        patch.setattr(os, "open", refuse)
        assert is_locked(lock)
    lock.touch()  # a process was killed
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refuse)
        assert not is_locked(lock)
    assert lock.exists()
    assert not is_locked(lock)


def test_a_lock_that_its_folder_was_moved_with(tmp_path):
    with one_run(tmp_path / "out"):
        (tmp_path / "out").rename(tmp_path / "moved")
        with pytest.raises(InUse), one_run(tmp_path / "moved", wait=0):
            pass
        with one_run(tmp_path / "out"):  # another folder
            (tmp_path / "out" / "result").touch()
    with one_run(tmp_path / "moved"):
        pass


@pytest.mark.parametrize("renewed", [True, False])
@pytest.mark.parametrize("has_locks", [True, False])
def test_a_file_system_that_does_not_pass_locks_on(tmp_path, monkeypatch, renewed, has_locks):
    monkeypatch.setattr(run_lock, "_SILENT_SECONDS", 1.2)
    file, host = tmp_path / "lock", "elsewhere" if has_locks else socket.gethostname()
    holder = {"host": host, "process": 7, "since": "now", "command": "snowsplat train"}
    file.write_text(json.dumps(holder), encoding="utf-8")
    if not has_locks:

        def unsupported(handle: int) -> bool:
            raise OSError("no locks")

        monkeypatch.setattr(run_lock, "_lock", unsupported)
    timer = threading.Timer(0.2, os.utime, [file])
    if renewed:
        timer.start()
        with (
            pytest.raises(InUse, match=f"a: in use by process 7 on {host}"),
            locked(file, "a"),
        ):
            pass
        assert json.loads(file.read_text("utf-8")) == holder
    else:
        with locked(file, "a"):
            assert json.loads(file.read_text("utf-8"))["process"] == os.getpid()
        assert not file.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("text", encoding="utf-8")
    (tmp_path / LOCK).symlink_to("precious")
    with pytest.raises(OSError), one_run(tmp_path):  # noqa: PT011
        pass
    assert (tmp_path / "precious").read_text(encoding="utf-8") == "text"
