"""Jobs: one per folder, stopped, killed; what a worker tells."""

import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.pipeline.make_plan import training_seconds
from snowsplat.project.studio_scene import StudioScene
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.sfm.cost import Speed
from snowsplat.studio import job, worker
from snowsplat.studio.recorder import Recorder
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.trainer import Progress
from snowsplat.util.errors import UserError

from ..waiting import wait_until


def begun(scene: StudioScene) -> int:
    """The process of the job, when it has the lock."""
    wait_until(lambda: "process" in scene.state())
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
    wait_until(lambda: not job.is_running(scene))
    os.waitpid(process, 0)
    assert scene.state() == {"outcome": "stopped"}
    job.stop(scene)  # nothing to do


def test_a_killed_job_leaves_no_lock(library, holder):
    scene = library.new("a", [])
    job.start(scene)
    os.kill(begun(scene), signal.SIGKILL)
    wait_until(lambda: not job.is_running(scene))
    assert "outcome" not in scene.state()
    (scene.folder / "state.json").unlink()
    job.start(scene)
    begun(scene)
    job.stop(scene)
    wait_until(lambda: scene.state() == {"outcome": "stopped"})


def test_a_job_of_another_computer_is_not_stopped(library, holder, monkeypatch):
    scene = library.new("a", [])
    job.start(scene)
    process = begun(scene)
    started = job._started.pop(scene.lock())
    # The file of the lock is what tells.
    scene.lock().write_text(json.dumps({"host": "elsewhere", "process": os.getpid()}))
    with pytest.raises(UserError, match="is being made on elsewhere; stop it there"):
        job.stop(scene)
    # Of another user, who names a process of this one; or all of them.
    killed = []
    for named, own in ((process, False), (-1, True), (0, True)):
        scene.lock().write_text(json.dumps({"host": socket.gethostname(), "process": named}))
        with monkeypatch.context() as patch:
            patch.setattr(os, "kill", lambda number, how: how and killed.append(number))
            patch.setattr(job, "is_own", lambda _, own=own: own)
            with pytest.raises(UserError, match="stop it there"):
                job.stop(scene)
    assert not killed
    os.kill(process, signal.SIGKILL)
    started.wait()


def test_errors_of_the_worker_are_one_line(library, forked, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    scene = library.new("a", [empty])
    with pytest.raises(UserError, match="empty"):
        job.work(scene, "survey")
    with pytest.raises(UserError, match="the scene is not finished"):
        job.work(scene, "export", kind="spz")
    job.start(scene)
    wait_until(lambda: not job.is_running(scene), 60)
    state = scene.state()
    assert state["outcome"] == "failed"
    assert "empty" in state["error"]["en"]
    assert "\n" not in state["error"]["en"]


def test_what_the_photos_are(library, request):
    """In a zip file, which is unpacked; again, it is the same. The first process is a new one."""
    scene = library.new("a", [])
    scene.photos.mkdir()
    with zipfile.ZipFile(scene.photos / "tour.zip", "w") as archive:
        for number in range(3):
            picture = io.BytesIO()
            colours = np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8)
            Image.fromarray(colours).save(picture, "JPEG")
            archive.writestr(f"tour/{number}.jpg", picture.getvalue())
    for _ in range(2):
        found = job.work(scene, "survey")
        assert (found["count"], found["facts"]["photos"]) == (3, 3)
        assert 0 < found["seconds"]["draft"] < found["seconds"]["best"]
        request.getfixturevalue("forked")


def test_poses_that_are_given_take_no_time(library, tmp_path, monkeypatch):
    dataset = write_toy_dataset(tmp_path / "dataset", "colmap-bin", 9, 48, 36, n_points=300)
    photos = tmp_path / "photos"
    shutil.copytree(dataset / "images", photos)
    monkeypatch.setattr(worker, "measure_speed", lambda _: Speed())
    given, unknown = (worker.survey_photos(library.new("a", [each])) for each in (dataset, photos))
    assert (given["facts"]["poses"], unknown["facts"]["poses"]) == (True, False)
    alone = round(training_seconds("draft", 9, Speed()))
    assert given["seconds"]["draft"] == alone < unknown["seconds"]["draft"]


def test_progress_is_bounded(library):
    """The curve has a limited number of points, over all steps; numbers are those of the steps."""
    scene = library.new("a", [])
    recorder = Recorder(scene)
    for step in range(1, 5001):
        recorder.step(Progress(step, 1.0 / step, 100 + step, 5000, 1, seconds_left=7.0))
    recorder.note("a line\x1b[0m")
    state = scene.state()
    assert state["steps"] == {"step": 5000, "iterations": 5000, "gaussians": 5100, "left": 7.0}
    assert len(state["curve"]) <= 400
    steps = [step for step, _ in state["curve"]]
    assert steps == sorted(steps)
    assert steps[-1] > 4900
    assert steps[0] < 100
    assert "\x1b" not in state["notes"][-1]["en"]
    # There is no map of cameras that are not there, and one note about it.
    assert len(state["notes"]) == 2


def test_given_cameras_have_a_map(library):
    scene = library.new("a", [])
    recorder = Recorder(scene)
    pose = torch.eye(3, 4, dtype=torch.float64)
    training = TrainingFolder(scene.made / "scene")
    settings = {"sh_degree": 0, "background": "black"}
    training.write_settings(DatasetSettings("photos"), settings)
    write_cameras(training.cameras, [("one", Camera(60, 40, 50.0, 50.0, 30.0, 20.0, pose))])
    recorder.step(Progress(1, 1.0, 100, 5000, 1))
    assert scene.map.read_text("utf-8").startswith("<svg")
    assert not scene.state()["notes"]


def test_a_worker_that_is_killed_is_an_error(library, monkeypatch):
    monkeypatch.setattr(job, "_WORKER", [sys.executable, "-c", "import os; os.abort()"])
    with pytest.raises(UserError, match="unexpected fault"):
        job.work(StudioScene(library.folder), "survey")
