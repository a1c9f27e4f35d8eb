"""`train --processes` and `torchrun`: the same files as one process; a process that ends."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from snowsplat.cli.main import main
from snowsplat.pipeline.run import processes
from snowsplat.util.errors import UserError

from ..fork_server import popen, run
from ..kill.harness import SEED, TIMES

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and the name lo")
FLAGS = ["--iterations", "120", "--batch", "4", "--checkpoint-every", "40", "--eval", "-q"]
SCENE = "point_cloud/iteration_120/point_cloud.ply"


TRAIN = ("-m", "snowsplat", "train")


@pytest.fixture(scope="module")
def scene(dataset: Path) -> bytes:
    """The scene that one process trains."""
    out = dataset.parent / "alone"
    assert main(["train", str(dataset), "-o", str(out), *FLAGS]) == 0
    return (out / SCENE).read_bytes()


def children_of(process: int, count: int = 2) -> list[int]:
    """The processes that train, in the order of their numbers."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    assert len(children) == count
    return [int(child) for child in children]


@pytest.mark.slow
def test_several_processes_write_the_files_of_one(dataset, scene, tmp_path):
    out = tmp_path / "out"
    done = run(*TRAIN, dataset, "-o", out, *FLAGS, "--processes", 2, forks=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert re.search(r"120 steps in .*\n.*report of the training\nstep 120: \d views", done.stdout)
    assert (out / SCENE).read_bytes() == scene
    names = {path.name for path in (dataset.parent / "alone").iterdir()}
    assert {path.name for path in out.iterdir()} == names


@pytest.mark.slow
def test_a_killed_process_ends_all_and_another_number_of_processes_resumes(
    dataset, scene, tmp_path
):
    killed, out = 1, tmp_path / "out"
    parent = popen(*TRAIN, dataset, "-o", out, *FLAGS, "--processes", 2, forks=True)
    try:
        while not list(out.glob("checkpoints/step_*")):
            assert parent.poll() is None
            time.sleep(0.02)
        children = children_of(parent.pid)
        os.kill(children[killed], signal.SIGKILL)
        _, errors = parent.communicate(timeout=60)
    finally:
        parent.kill()
    assert parent.returncode == 2
    assert errors == (
        f"snowsplat: process {killed} was ended by SIGKILL, so the training has stopped; rerun the "
        "command with --resume to continue from the last checkpoint\n"
    )
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    assert main(["train", "-o", str(out), "--resume", "-q"]) == 0
    assert (out / SCENE).read_bytes() == scene


@pytest.mark.nightly
@pytest.mark.parametrize("case", range(3 * TIMES))
def test_one_of_four_processes_is_killed_at_any_time(dataset, scene, tmp_path, case):
    """1, 2 or 3 processes resume, or begin again if there was no checkpoint yet."""
    chance, out = random.Random(f"{SEED} {case}"), tmp_path / "out"
    parent = popen(*TRAIN, dataset, "-o", out, *FLAGS, "--processes", 4, forks=True)
    time.sleep(chance.uniform(0.5, 8.0))
    with suppress(AssertionError, OSError):  # it is just starting or ending
        os.kill(children_of(parent.pid, 4)[chance.randrange(4)], signal.SIGKILL)
    _, errors = parent.communicate(timeout=120)
    assert (parent.returncode, len(errors.splitlines())) in ((0, 0), (2, 1)), errors
    resumed = ("--resume", "--processes", chance.choice([1, 2, 3]))
    done = run(*TRAIN, dataset, "-o", out, *FLAGS, *resumed, forks=True)
    assert done.returncode == 0, done.stderr
    assert (out / SCENE).read_bytes() == scene


@pytest.mark.slow
def test_ctrl_c_saves_the_scene_and_a_checkpoint(dataset, tmp_path):
    out = tmp_path / "out"
    flags = [flag if flag != "120" else "100000" for flag in FLAGS]
    parent = popen(*TRAIN, dataset, "-o", out, *flags, "--processes", 2, forks=True)
    try:
        while not list(out.glob("checkpoints/step_*")):
            assert parent.poll() is None
            time.sleep(0.02)
        for process in (parent.pid, *children_of(parent.pid)):  # as a terminal does
            os.kill(process, signal.SIGINT)
        output, _ = parent.communicate(timeout=60)
    finally:
        parent.kill()
    assert parent.returncode == 130
    step = int(re.search(r"stopped after step (\d+)", output)[1])
    assert (out / f"point_cloud/iteration_{step}/point_cloud.ply").exists()
    assert (out / f"checkpoints/step_{step:06d}.safetensors").exists()


@pytest.mark.nightly  # test_shards.py has the same variables in forks
def test_torchrun(dataset, scene, tmp_path):
    """Here, all processes are new ones, not forks."""
    command = [sys.executable, "-m", "torch.distributed.run"]
    command += ["--standalone", "--nproc-per-node=2", "-m", "snowsplat", "train"]
    command += [str(dataset), "-o", str(tmp_path / "out"), *FLAGS]
    subprocess.run(command, check=True, timeout=300, stderr=subprocess.DEVNULL)
    assert (tmp_path / "out" / SCENE).read_bytes() == scene


@pytest.mark.slow
def test_an_error_of_the_first_process_is_reported_once(dataset, tmp_path):
    absent = ("--images", "absent")
    done = run(*TRAIN, dataset, "-o", tmp_path / "out", *absent, "--processes", 2, forks=True)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "absent" in done.stderr


def test_the_number_of_processes():
    with pytest.raises(UserError, match="0 processes are too few"):
        processes.launch(0, [])
    assert processes.count() == 1
    assert processes.is_first()
