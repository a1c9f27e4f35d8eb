"""One run per folder: waiting, messages, killed processes, and holders on other computers."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from snowsplat.util import run_lock
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
from snowsplat.util.run_lock import LOCK, InUse, LostLock, is_locked, locked, one_run

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
        patch.setattr(Path, "unlink", lambda path, **_: refuse(path, os.O_RDWR))
        assert not is_locked(lock)
        with pytest.raises(UserError, match="is no lock, or that of another user; remove it"):
            one_run(tmp_path).__enter__()
    assert lock.exists()
    assert not is_locked(lock)


def test_a_lock_that_its_folder_was_moved_with(tmp_path):
    with one_run(tmp_path / "out"):
        (tmp_path / "out").rename(tmp_path / "moved")
        with pytest.raises(InUse), one_run(tmp_path / "moved", wait=0):
            pass
        with one_run(tmp_path / "out"):  # another folder
            (tmp_path / "out" / "result").touch()
            with pytest.raises(LostLock):
                write_text(tmp_path / "out" / "result", "of the first")
    with one_run(tmp_path / "moved"):
        pass


def test_a_lock_that_was_removed_is_taken_again(tmp_path):
    with one_run(tmp_path):
        for _ in range(2):
            (tmp_path / LOCK).unlink()
            write_text(tmp_path / "result", "text")
            with pytest.raises(InUse), one_run(tmp_path, wait=0):
                pass
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


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
    with pytest.raises(UserError, match="is no lock"), one_run(tmp_path):
        pass
    assert (tmp_path / "precious").read_text(encoding="utf-8") == "text"


@pytest.mark.skipif(sys.platform == "win32", reason="needs pipes with names")
@pytest.mark.parametrize("make", [os.mkdir, getattr(os, "mkfifo", os.mkdir)])
def test_what_is_no_lock_is_named(tmp_path, make):
    make(tmp_path / LOCK)
    with pytest.raises(UserError, match=r"lock: is no lock, .* remove it"), one_run(tmp_path):
        pass


# Takes the lock as on a file system without locks, and writes a file when it is told to.
_SLEEPER = """
import sys
from pathlib import Path
from snowsplat.util import run_lock
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
def unsupported(handle):
    raise OSError("no locks")
if sys.argv[2] == "without locks":
    run_lock._lock = unsupported
out = Path(sys.argv[1])
with run_lock.one_run(out):
    write_text(out / "first", "written")
    print("held", flush=True)
    sys.stdin.readline()
    for _ in range(2):
        try:
            write_text(out / "first", "spoilt")
        except UserError as error:
            print(error, flush=True)
    write_text(out.parent / "elsewhere", "written")
"""


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs a process that sleeps")
@pytest.mark.parametrize("how", ["without locks", "removed"])
def test_a_holder_that_slept_while_another_took_the_lock(tmp_path, monkeypatch, how):
    """It writes nothing more into the folder, and the lock of the other one remains."""
    out = tmp_path / "out"
    command = [sys.executable, "-c", _SLEEPER, str(out), how]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as sleeper:
        assert sleeper.stdin is not None
        assert sleeper.stdout is not None
        assert sleeper.stdout.readline() == "held\n"
        sleeper.send_signal(signal.SIGSTOP)
        if how == "removed":
            (out / LOCK).unlink()
        else:
            monkeypatch.setattr(run_lock, "_SILENT_SECONDS", 0.0)
            monkeypatch.setattr(run_lock, "_lock", _without_locks)
        with one_run(out):
            write_text(out / "first", "of the other")
            sleeper.send_signal(signal.SIGCONT)
            lines = sleeper.communicate("\n", timeout=60)[0].splitlines()
            who = f"its lock was lost while this process slept, now to process {os.getpid()} "
            assert len(lines) == 2
            assert all(who in line and "writes nothing more" in line for line in lines)
            assert sleeper.returncode == 0
            assert (out / LOCK).exists()
            assert [path.name for path in out.iterdir() if path.name != LOCK] == ["first"]
            assert (out / "first").read_text() == "of the other"
    assert (tmp_path / "elsewhere").exists()
    assert not (out / LOCK).exists()


def _without_locks(handle: int) -> bool:
    raise OSError("no locks")


@pytest.mark.skipif(sys.platform == "win32", reason="processes have no such numbers there")
def test_a_stranger_cannot_hold_the_lock_of_a_dead_process(tmp_path):
    """Whoever can read its file can lock it."""
    lock = tmp_path / LOCK
    with subprocess.Popen([sys.executable, "-c", _HOLD, str(tmp_path)], stdout=-1) as dead:
        assert dead.stdout is not None
        dead.stdout.readline()
        dead.kill()
    handle = os.open(lock, os.O_RDONLY)
    try:
        assert run_lock._lock(handle)  # of a stranger
        assert not is_locked(lock)
    finally:
        os.close(handle)
    lock.touch()
    handle = os.open(lock, os.O_RDONLY)
    try:
        assert run_lock._lock(handle)
        # It may be that of a container, whose processes have other numbers.
        other = {"host": socket.gethostname(), "process": dead.pid, "space": "pid:[1]"}
        lock.write_text(json.dumps(other))
        assert is_locked(lock)
    finally:
        os.close(handle)
    with one_run(tmp_path):
        assert json.loads(lock.read_text("utf-8"))["process"] == os.getpid()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs two users")
@pytest.mark.parametrize("in_use", [True, False])
def test_a_lock_of_another_user_in_an_own_folder(in_use):
    """As after `sudo snowsplat train`, which was killed, or which still runs."""
    with tempfile.TemporaryDirectory() as name:  # other users can enter the folder above
        folder = Path(name)
        (folder / LOCK).touch(mode=0o644)  # of the administrator
        os.chown(folder, 4321, 4321)
        handle = os.open(folder / LOCK, os.O_RDONLY)
        try:
            if in_use:
                assert run_lock._lock(handle)
            os.seteuid(4321)
            if in_use:
                with pytest.raises(UserError, match="that of another user"), one_run(folder, 0):
                    pass
            else:
                with one_run(folder):
                    assert (folder / LOCK).stat().st_uid == 4321
        finally:
            os.seteuid(0)
            os.close(handle)
