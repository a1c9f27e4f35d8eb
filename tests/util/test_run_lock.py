"""One run per folder: waiting, messages, killed processes, and removed locks."""

import errno
import json
import os
import socket
import subprocess
import sys
import tempfile
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


def test_a_lock_that_is_no_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/lib/snowsplat/__main__.py", "studio", "my scenes"])
    file = tmp_path / "edit.lock"
    with locked(file, "garden"):
        assert is_locked(file)
        begin = time.monotonic()
        with pytest.raises(
            InUse, match=r"^garden: in use by .*: snowsplat studio 'my scenes'; wait"
        ):
            locked(file, "garden", wait=0.2).__enter__()
        assert 0.2 <= time.monotonic() - begin < 2.0
    assert not file.exists()
    assert not is_locked(file)


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


def test_a_lock_that_was_removed(tmp_path):
    """Who then takes it is not disturbed: the first one writes nothing more there."""
    out = tmp_path / "out"
    with one_run(out):
        (out / LOCK).unlink()
        write_text(out / "result", "of the first")
        with one_run(out):
            for _ in range(2):
                with pytest.raises(LostLock, match=rf"now that of process {os.getpid()} "):
                    write_text(out / "result", "spoilt")
            write_text(tmp_path / "elsewhere", "text")
            assert (out / "result").read_text("utf-8") == "of the first"
            assert (out / LOCK).exists()
    assert [path.name for path in out.iterdir()] == ["result"]


@pytest.mark.skipif(sys.platform == "win32", reason="has other locks")
def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def unsupported(handle: int, kind: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(run_lock.fcntl, "flock", unsupported)
    with one_run(tmp_path):
        assert not is_locked(tmp_path / LOCK)
    assert not (tmp_path / LOCK).exists()


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
