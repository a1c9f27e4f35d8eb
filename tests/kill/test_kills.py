"""Kills of each subcommand, at times that depend on a seed; then it runs to its end: see `harness`.

`SNOWSPLAT_KILLS=10` makes ten times as many, and `SNOWSPLAT_SEED=2` others. Defects are listed, and
their folders are kept.
"""

import json
import os
import re
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from snowsplat.formats import write_gaussians
from snowsplat.training.core import checkpoint

from .harness import (
    SEED,
    TIMES,
    Killer,
    convert_jobs,
    digest,
    make_jobs,
    names_in,
    publish_jobs,
    sfm_jobs,
    some_gaussians,
    studio_jobs,
    studio_make_jobs,
    train_jobs,
)


@pytest.fixture(scope="module")
def killer(runner) -> Killer:
    return Killer(runner, SEED)


@pytest.fixture
def scenes(tmp_path) -> tuple[Path, Path]:
    placed = replace(some_gaussians(2000, 1), origin=(5e5, 20.0, -5.4e6))
    write_gaussians(tmp_path / "in.ply", placed)
    write_gaussians(tmp_path / "other.ply", some_gaussians(100, 2))
    return tmp_path / "in.ply", tmp_path / "other.ply"


def test_convert(killer, scenes):
    assert not killer.kill(convert_jobs(*scenes), 4 * TIMES)


def test_publish(killer, scenes):
    assert not killer.kill(publish_jobs(*scenes), 3 * TIMES)


def test_studio(killer, scenes):
    assert not killer.kill(studio_jobs(scenes[0])[: 2 * TIMES], 3 * TIMES)


def test_train(killer, dataset):
    assert not killer.kill(train_jobs(dataset), 4 * TIMES)


@pytest.mark.nightly  # a part of `make`
def test_sfm(killer, photos):
    assert not killer.kill(sfm_jobs(photos), 3 * TIMES)


def test_make(killer, photos):
    assert not killer.kill(make_jobs(photos), 3 * TIMES)


@pytest.mark.nightly  # one run takes a minute
def test_the_job_of_the_studio(killer, photos):
    assert not killer.kill(studio_make_jobs(photos), TIMES)


def test_train_killed_at_its_start(runner, dataset):
    """It is killed before each of the first changes of files, and the folder is recognised."""
    out = runner.folder / "begun"
    command = ["train", dataset, "-o", out, "--iterations", 3, "--device", "cpu", "--threads", 1]
    for at in range(1, 8):
        ended = runner.run([*command, "--resume"], at=at)
        assert ended.killed, ended.text
    done = runner.run([*command, "--resume"])
    assert done.code == 0, done.text
    assert not list(out.rglob("*.tmp"))


def test_a_scene_is_written_after_a_kill_prevented_it(runner, dataset, tmp_path):
    """The run is killed after the checkpoint of step 20 and before the scene of step 20."""
    out = tmp_path / "out"
    command = ["train", dataset, "-o", out, "--iterations", 30, "--checkpoint-every", 10]
    command += ["--save-iterations", 20, "--device", "cpu", "--threads", 1]
    assert runner.run(command).code == 0
    early = out / "point_cloud/iteration_20/point_cloud.ply"
    whole = digest(early)
    early.unlink()
    (out / "checkpoints/step_000030.safetensors").unlink()
    done = runner.run([*command, "--resume"])
    assert done.code == 0, done.text
    assert digest(early) == whole


def test_an_old_checkpoint_left_by_a_kill_is_removed(runner, dataset, tmp_path):
    """The run is killed after writing the last checkpoint and before removing the third last."""
    out = tmp_path / "out"
    command = ["train", dataset, "-o", out, "--iterations", 30, "--checkpoint-every", 10]
    command += ["--device", "cpu", "--threads", 1]
    assert runner.run(command).code == 0
    remaining = names_in(out / "checkpoints")
    assert remaining == {"step_000020.safetensors", "step_000030.safetensors"}
    shutil.copy(
        out / "checkpoints/step_000020.safetensors", out / "checkpoints/step_000010.safetensors"
    )
    done = runner.run([*command, "--resume"])
    assert done.code == 0, done.text
    assert names_in(out / "checkpoints") == remaining


def test_damaged_checkpoints_are_not_overwritten(runner, dataset, tmp_path):
    out = tmp_path / "out"
    command = ["train", dataset, "-o", out, "--iterations", 20, "--checkpoint-every", 10]
    command += ["--device", "cpu", "--threads", 1]
    assert runner.run(command).code == 0
    shutil.rmtree(out / "point_cloud")
    for path in (out / "checkpoints").iterdir():
        path.write_bytes(path.read_bytes()[:-1])
    before = {name: (out / name).read_bytes() for name in names_in(out)}
    ended = runner.run([*command, "--resume"])
    assert ended.code == 2
    assert "contains checkpoints but no complete checkpoint to resume" in ended.text
    assert {name: (out / name).read_bytes() for name in names_in(out)} == before


def test_a_timed_run_with_more_steps_than_planned(runner, dataset, tmp_path):
    """The final checkpoint is beyond the plan that is stored in it."""
    out = tmp_path / "out"
    command = ["train", dataset, "-o", out, "--minutes", 0.02, "--checkpoint-every", 1]
    command += ["--device", "cpu", "--threads", 1]
    assert runner.run(command).code == 0
    newest = checkpoint.latest(out / "checkpoints")
    assert newest is not None
    newest.meta["training"]["iterations"] = newest.step
    checkpoint.save(out / "checkpoints", newest.step + 3, newest.tensors, newest.meta)
    done = runner.run([*command, "--resume"])
    assert done.code == 0, done.text


def test_make_keeps_checkpoints_until_the_scene_is_recorded(killer, runner, photos, tmp_path):
    """The run is killed as soon as they are removed; the stage must be recorded as finished."""
    (job,) = make_jobs(photos)
    whole, _ = killer.reference(job)
    out = tmp_path / "made"
    shutil.copytree(whole / job.output, out)
    # Only the poses are kept.
    shutil.rmtree(out / "scene")
    record = json.loads((out / "make.json").read_text())
    record["stages"] = {}
    (out / "make.json").write_text(json.dumps(record))
    command = job.command(out, True)
    checkpoints = out / "scene/checkpoints"
    (scene,) = (whole / job.output).glob("scene/point_cloud/*/point_cloud.ply")
    last = out / scene.relative_to(whole / job.output)

    def kill_when_gone(pid: int) -> None:
        process = Path(f"/proc/{pid}")
        while not last.exists() and process.exists():
            time.sleep(0.005)
        assert checkpoints.exists()
        while checkpoints.exists() and process.exists():
            pass  # without a delay, since the record may be written soon afterwards
        os.killpg(pid, signal.SIGKILL)

    assert runner.run(command, while_it_runs=kill_when_gone).killed
    assert "scene" in json.loads((out / "make.json").read_text())["stages"]
    # The state after an earlier kill.
    checkpoints.mkdir()
    again = runner.run(command)
    assert again.code == 0, again.text
    assert re.search(r"scene .*done before", again.text)
    assert not checkpoints.exists()
