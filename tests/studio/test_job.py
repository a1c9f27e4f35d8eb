"""Jobs: one per folder, stopped, killed; what a worker tells."""

import os
import signal
import subprocess
import sys
import time

import pytest

from snowsplat.studio import job
from snowsplat.studio.library import Scene
from snowsplat.util.errors import UserError


def wait_for(true, seconds=30.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def begun(scene: Scene) -> int:
    """The process of the job, when it has the lock."""
    wait_for(lambda: "process" in scene.state())
    return scene.state()["process"]


def test_two_jobs_in_one_folder_are_refused(library, holder):
    scene = library.new("a", [])
    job.start(scene)
    with pytest.raises(UserError, match="is being made already"):
        job.start(scene)
    process = begun(scene)
    # A studio that has not started it knows it, too; and so does a second worker.
    job._started.clear()
    assert job.is_running(scene)
    with pytest.raises(UserError, match="is being made already"):
        job.start(scene)
    second = [*job._WORKER, "make", str(scene.folder)]
    assert subprocess.run(second, check=False).returncode == 2
    assert scene.state()["process"] == process
    job.stop(scene)
    wait_for(lambda: not job.is_running(scene))
    os.waitpid(process, 0)
    assert scene.state() == {"outcome": "stopped"}
    job.stop(scene)  # nothing to do


def test_a_killed_job_leaves_no_lock(library, holder):
    scene = library.new("a", [])
    job.start(scene)
    os.kill(begun(scene), signal.SIGKILL)
    wait_for(lambda: not job.is_running(scene))
    assert "outcome" not in scene.state()
    (scene.folder / "state.json").unlink()
    job.start(scene)
    begun(scene)
    job.stop(scene)
    wait_for(lambda: scene.state() == {"outcome": "stopped"})


def test_a_job_of_another_computer_is_not_stopped(library, holder):
    scene = library.new("a", [])
    job.start(scene)
    process = begun(scene)
    started = job._started.pop(scene.folder)
    scene.write_state({"process": os.getpid(), "host": "elsewhere"})
    with pytest.raises(UserError, match="is being made on elsewhere"):
        job.stop(scene)
    os.kill(process, signal.SIGKILL)
    started.wait()


def test_errors_of_the_worker_are_one_line(library, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    scene = library.new("a", [empty])
    with pytest.raises(UserError, match="empty"):
        job.work("survey", scene.folder)
    with pytest.raises(UserError, match="the scene is not finished"):
        job.work("export", scene.folder, "spz")
    job.start(scene)
    wait_for(lambda: not job.is_running(scene), 60)
    state = scene.state()
    assert state["outcome"] == "failed"
    assert "empty" in state["error"]
    assert "\n" not in state["error"]


def test_a_worker_that_is_killed_is_an_error(library, monkeypatch):
    monkeypatch.setattr(job, "_WORKER", [sys.executable, "-c", "import os; os.abort()"])
    with pytest.raises(UserError, match="unexpected fault"):
        job.work("survey", library.folder)
