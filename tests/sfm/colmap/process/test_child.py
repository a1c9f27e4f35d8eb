"""The child process ends with its parent, and a crash is reported or handled by a second run."""

import json
import os
import resource
import signal
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from snowsplat.sfm.colmap import estimate_poses
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent
from snowsplat.util.errors import UserError

from ....fork_server import popen
from ....waiting import wait_until
from .. import scenes
from ..forks import children_in_forks

DRAFT = SfmOptions(effort="draft", threads=2)
CHILDREN = Path("/proc/self/task") / str(os.getpid()) / "children"

# This program stops its child process when a given step of the progress begins. So the child does
# not end before the test kills this program.
PARENT = """
import json, os, signal, sys
from pathlib import Path
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.colmap import estimate_poses
from snowsplat.sfm.options import SfmOptions

def report(done, total, what):
    if what == sys.argv[3]:
        for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
            os.kill(int(child), signal.SIGSTOP)
        print(what, flush=True)
        signal.pause()

photos = [Photo(**photo) for photo in json.loads(sys.argv[2])]
estimate_poses(Path(sys.argv[1]), photos, SfmOptions(effort="draft", threads=2), report)
"""

pytestmark = pytest.mark.sfm
#: Of moments that differ only in what the next run finds finished.
NIGHTLY = pytest.mark.nightly

needs_proc = pytest.mark.skipif(
    not CHILDREN.exists(), reason="needs /proc, to find the child process"
)


@pytest.fixture(scope="module")
def pictures():
    boards = scenes.boards()
    return [scenes.photograph(boards, pose, i) for i, pose in enumerate(scenes.arc(6)[:4])]


@pytest.fixture
def photos(tmp_path, pictures):
    return scenes.write(tmp_path, pictures)


def children_of(pid):
    """The child processes in which COLMAP runs."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    commands = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return [child for child, command in commands.items() if b"colmap.process.worker" in command]


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def kill_child(number=signal.SIGKILL):
    for child in children_of(os.getpid()):
        os.kill(child, number)


def assert_continues(dataset, photos):
    """The next run reuses what was finished."""
    with children_in_forks():
        assert len(estimate_poses(dataset, photos, DRAFT, silent).registered) == len(photos)


@needs_proc
def test_after_one_crash_it_is_repeated_with_less_effort(tmp_path, photos):
    photos, killed = photos[:3], []

    def report(done, total, what):
        if what == "verified pairs" and not killed:
            killed.append(True)
            kill_child(signal.SIGSEGV)

    result = estimate_poses(tmp_path, photos, DRAFT, report)
    assert len(result.registered) == len(photos)
    assert "crashed (SIGSEGV)" in result.attempts[0]
    assert "1024 features" in result.attempts[1]
    # The handlers of COLMAP's logger, which may hang, are not called.
    assert "*** Aborted" not in (tmp_path / "distorted" / "colmap.log").read_text()


@needs_proc
@pytest.mark.parametrize(
    "what",
    [
        *(pytest.param(w, marks=NIGHTLY) for w in ("photos with features", "verified pairs")),
        "registered photos",
    ],
)
def test_two_crashes_are_reported_in_one_line(tmp_path, photos, what):
    # Four photos keep the mapper busy until it is killed. The other steps need only three.
    if what != "registered photos":
        photos = photos[:3]

    def report(done, total, now):
        # With a low priority, the child does not finish the step before this process kills it.
        if now == "photos with features":
            for child in children_of(os.getpid()):
                os.setpriority(os.PRIO_PROCESS, child, 19)
        if now == what:
            kill_child()

    with pytest.raises(UserError, match="failed twice: it was killed.*memory") as caught:
        estimate_poses(tmp_path, photos, DRAFT, report)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "distorted" / "sparse").exists()
    assert_continues(tmp_path, photos)


@needs_proc
def test_interrupt_ends_the_child(tmp_path, photos):
    photos, seen = photos[:3], []

    def report(done, total, what):
        if what == "verified pairs":
            seen.extend(children_of(os.getpid()))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_poses(tmp_path, photos, DRAFT, report)
    assert seen
    assert not any(is_alive(child) for child in seen)
    assert_continues(tmp_path, photos)


@needs_proc
@pytest.mark.parametrize(
    ("what", "number"),
    [
        pytest.param("photos with features", signal.SIGKILL, marks=NIGHTLY),
        ("verified pairs", signal.SIGTERM),
        pytest.param("registered photos", signal.SIGKILL, marks=NIGHTLY),
    ],
)
def test_child_ends_with_a_killed_parent(tmp_path, photos, what, number):
    photos_json = json.dumps([asdict(photo) for photo in photos])
    with popen("-c", PARENT, tmp_path, photos_json, what) as parent:
        assert parent.stdout.readline().strip() == what
        (child,) = children_of(parent.pid)
        parent.send_signal(number)
        parent.wait()
        os.kill(child, signal.SIGCONT)
        wait_until(lambda: not is_alive(child))
    assert not (tmp_path / "distorted" / "sparse").exists()  # it has not finished its work
    assert_continues(tmp_path, photos)


def test_errors_in_the_child_are_in_the_log(tmp_path, photos, monkeypatch):
    """Without the photo files both runs fail; the error has the last line of the log. The child has
    found its modules, with another numpy in the current folder, and relative paths in sys.path."""
    for path in (tmp_path / "input").iterdir():
        path.unlink()
    root = next(path for path in sys.path if (Path(path) / "snowsplat" / "__init__.py").exists())
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    (elsewhere / "numpy.py").write_text("raise ImportError('the wrong numpy')")
    monkeypatch.chdir(elsewhere)
    monkeypatch.setattr(sys, "path", [os.path.relpath(root), *sys.path])
    if sys.version_info < (3, 11):
        (elsewhere / "numpy.py").unlink()  # older Python does not have PYTHONSAFEPATH
    with pytest.raises(
        UserError, match=r"failed twice: it ended with status 1; report it \(.*FileNotFoundError"
    ):
        estimate_poses(Path(os.path.relpath(tmp_path)), photos[:3], DRAFT, silent)
    assert "FileNotFoundError" in (tmp_path / "distorted" / "colmap.log").read_text()


def test_files_that_cannot_grow_are_reported(tmp_path, photos):
    """COLMAP crashes on a full disk. The test simulates this by a limit of the file size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            estimate_poses(tmp_path, photos[:3], DRAFT, silent)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "distorted")
    assert_continues(tmp_path, photos[:3])
