"""`snowsplat train`, from flags to files: its output, errors, interruption and resuming."""

import json
import os
import re
import shutil
import signal
import time
import weakref
from pathlib import Path

import pytest

from snowsplat.cli.main import parse
from snowsplat.cli.train import Train
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.run.results import TrainResult
from snowsplat.pipeline.run.training_run import TrainingRun
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.names import setting_names
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.flags import flags_of

QUICK = ("--iterations", 30, "--threads", 1)


def scene(out: Path, iteration: int = 30) -> bytes:
    return (out / f"point_cloud/iteration_{iteration}/point_cloud.ply").read_bytes()


def files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def test_the_output_folder(run, dataset, tmp_path):
    out = tmp_path / "new" / "out"
    result = run("train", dataset, "-o", out, *QUICK, "--eval", "--save-iterations", 10, 20)
    assert result.code == 0, result.err
    assert result.err == ""
    assert files(out) == {
        *("cfg_args", "cameras.json", "input.ply", "config.json", "metrics.json"),
        *("history.json", "report.html"),
        *(f"point_cloud/iteration_{n}/point_cloud.ply" for n in (10, 20, 30)),
    }
    assert (out / "cfg_args").read_text().startswith("Namespace(data_device='cpu', eval=True, ")
    cameras = json.loads((out / "cameras.json").read_text())
    assert len(cameras) == 9
    assert cameras[0].keys() == {
        *("id", "img_name", "width", "height", "position", "rotation", "fx", "fy", "near"),
    }
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["iteration"] == 30
    assert metrics["split"] == "test"
    assert metrics["psnr"] > 12
    assert set(metrics["views"]) == {"view_00.png", "view_08.png"}
    assert b"element vertex 300" in (out / "input.ply").read_bytes()[:200]
    # Standard output is not a terminal, so complete lines are printed. The verdict is last.
    lines = result.out.splitlines()
    assert "7 photos to train on, 2 held out, 48x36, 300 points" in lines[0]
    assert any(line.startswith("step 30/30 (100%)") and "it/s" in line for line in lines)
    result_line = next(i for i, line in enumerate(lines) if line.startswith("step 30: 2 views"))
    assert lines[result_line + 1] == "the scene: poor; expect blurred or wrong parts"


def test_the_reference_spelling_of_flags(run, dataset, tmp_path):
    out = tmp_path / "out"
    result = run(
        *("train", "-s", dataset, "-m", out, "-i", "images", "-r", 2, "--eval", "-w", "--quiet"),
        *("--iterations", 20, "--sh_degree", 1, "--densify_grad_threshold", 0.0004),
        *("--densification_interval", 7, "--densify_from_iter", 3, "--densify_until_iter", 15),
        *("--opacity_reset_interval", 9, "--percent_dense", 0.02, "--lambda_dssim", 0.3),
        *("--position_lr_init", 1e-4, "--position_lr_final", 1e-6, "--position_lr_max_steps", 40),
        *("--feature_lr", 0.002, "--opacity_lr", 0.03, "--scaling_lr", 0.004),
        *("--rotation_lr", 0.005, "--test_iterations", -1, "--save_iterations", 10),
    )
    assert result.code == 0, result.err
    config = json.loads((out / "config.json").read_text())
    assert config["dataset"] == {
        "path": str(dataset),
        "images": "images",
        "resolution": 2,
        "hold_out": 8,
        "first_held_out": 0,
        "test_list": None,
        "left_out": None,
        "damaged": None,
    }
    training = config["training"]
    assert training["background"] == "white"
    assert (training["iterations"], training["sh_degree"], training["ssim_weight"]) == (20, 1, 0.3)
    assert training["test_iterations"] == []
    density = training["density"]
    assert density["grad_threshold"] == 0.0004
    assert (density["densify_interval"], density["densify_from"]) == (7, 3)
    assert (density["densify_until"], density["opacity_reset_interval"]) == (15, 9)
    assert density["percent_dense"] == 0.02
    rates = training["learning_rates"]
    assert {name: rate for name, rate in rates.items() if not name.startswith("anneal")} == {
        "means": 1e-4,
        "means_final": 1e-6,
        "means_steps": 40,
        "log_scales": 0.004,
        "quats": 0.005,
        "opacity_logits": 0.03,
        "sh_dc": 0.002,
        "sh_rest": 0.0001,
        "sh_rest_passes": 0.0,  # a given rate does not change
    }
    cameras = json.loads((out / "cameras.json").read_text())
    assert (cameras[0]["width"], cameras[0]["height"]) == (24, 18)
    assert "white_background=True" in (out / "cfg_args").read_text()
    assert b"f_rest_8\n" in scene(out, 20)
    assert b"f_rest_9\n" not in scene(out, 20)


def test_every_setting_is_a_flag_and_a_setting_of_some_recipe():
    settings = [flag.name for flag in flags_of(Train) if "settings" in flag.path]
    assert len(settings) >= 34
    assert set(settings) <= setting_names(recipe("default")).keys()


@pytest.mark.parametrize(("value", "expected"), [("on", True), ("off", False)])
def test_flags_with_the_values_on_and_off(value, expected):
    given = parse(["train", "garden", "-o", "out", "--abs-grad", value]).options.settings
    assert given == {"abs_grad": expected}


# Reproducing and resuming


def wait_for(path: Path, process) -> None:
    deadline = time.monotonic() + 60
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_ctrl_c_saves_and_resumes(run, start, dataset, tmp_path):
    stopped = tmp_path / "stopped"
    process = start("train", dataset, "-o", stopped, "--iterations", 100_000, "--threads", 1)
    deadline = time.monotonic() + 60
    while "step" not in (process.stdout.readline() if process.poll() is None else "step"):
        assert time.monotonic() < deadline
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, (out, err)
    assert err == ""
    assert f"resume with: snowsplat train -o {stopped} --resume" in out
    checkpoints = list((stopped / "checkpoints").iterdir())
    assert len(checkpoints) == 1
    step = int(checkpoints[0].stem.removeprefix("step_"))
    assert len(scene(stopped, step)) > 1000
    more = step + 5
    assert run("train", "-o", stopped, "--resume", "--iterations", more).code == 0
    assert len(scene(stopped, more)) > 1000


def test_a_second_ctrl_c_saves_no_incomplete_step(run, dataset, tmp_path, monkeypatch):
    """The files are the same as after a kill, and the resumed run produces the same scene."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    flags = ("--recipe", "mcmc", *QUICK, "--checkpoint-every", 10)
    assert run("train", dataset, "-o", whole, *flags).code == 0
    optimize = Trainer._optimize

    def press_twice(trainer: Trainer, step: int, *rest: object) -> None:
        optimize(trainer, step, *rest)
        if step == 25:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_optimize", press_twice)
        result = run("train", dataset, "-o", stopped, *flags)
    assert (result.code, result.err) == (130, "snowsplat: stopped\n")
    newest = stopped / "checkpoints/step_000020.safetensors"
    assert f"not saved; the last good checkpoint is {newest};" in result.out
    assert checkpoint.files(stopped / "checkpoints")[0] == (20, newest)
    assert not (stopped / "point_cloud").exists()
    assert run("train", "-o", stopped, "--resume").code == 0
    assert scene(stopped) == scene(whole)


def test_resume_rejects_other_settings(refused, run, dataset, tmp_path):
    out = tmp_path / "out"
    assert run("train", dataset, "-o", out, *QUICK, "--checkpoint-every", 30).code == 0
    assert "other settings" in refused("train", "-o", out, "--resume", "--seed", 5)
    assert "recipe" in refused("train", "-o", out, "--resume", "--recipe", "paper")
    assert "after --iterations 10" in refused("train", "-o", out, "--resume", "--iterations", 10)
    assert "cannot be combined" in refused("train", dataset, "-o", out, "--resume", "--overwrite")
    # With other photos or another split, the run would be tested on photos that it was trained on.
    (tmp_path / "tests.txt").write_text("view_04\n")
    for flags in (["-r", 2], ["--eval"], ["--test-list", tmp_path / "tests.txt"], ["-i", "more"]):
        assert "other settings" in refused("train", "-o", out, "--resume", *flags)
    moved = shutil.copytree(dataset, tmp_path / "moved")
    assert run("train", moved, "-o", out, "--resume", "-r", 1).code == 0
    before = scene(out)
    assert (
        run("train", "-o", out, "--resume").code == 0
    )  # already finished: the scene is written again
    assert scene(out) == before


def test_resume_without_a_checkpoint(refused, run, dataset, tmp_path):
    out = tmp_path / "out"
    assert "no complete checkpoint" in refused("train", "-o", out, "--resume")
    assert not out.exists()
    result = run("train", dataset, "-o", out, "--resume", *QUICK)
    assert result.code == 0
    assert "no checkpoint yet" in result.out
    assert "--overwrite" in refused("train", dataset, "-o", out, "--resume")


def test_resume_with_less_memory_than_its_gaussians_take(refused, run, tmp_path):
    """Resuming cannot reduce the number of Gaussians, so the budget must suffice for all."""
    dataset, out = tmp_path / "dataset", tmp_path / "out"
    write_toy_dataset(dataset, "blender", 3, 48, 36)
    flags = ("--recipe", "paper", "--initial-points", 5000, "--checkpoint-every", 2)
    assert run("train", dataset, "-o", out, *flags, "--iterations", 2).code == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    more = ("train", "-o", out, "--resume", "--iterations", 4)
    assert "to resume with 5,000 Gaussians" in refused(*more, "--memory", "70MB", "-q")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert run(*more, "--memory", "80MB").code == 0


def test_resume_keeps_no_second_copy_of_the_state(run, dataset, tmp_path, monkeypatch):
    """The tensors of the checkpoint are released before the training starts."""
    out, read = tmp_path / "out", []
    assert run("train", dataset, "-o", out, *QUICK, "--checkpoint-every", 20).code == 0
    load, train = checkpoint.latest, TrainingRun.run

    def latest(folder: Path) -> checkpoint.Checkpoint:
        start = load(folder)
        read.extend(weakref.ref(tensor) for tensor in start.tensors.values())
        return start

    def checked_run(training: TrainingRun) -> TrainResult:
        assert read
        assert not [tensor for tensor in read if tensor() is not None]
        return train(training)

    monkeypatch.setattr(checkpoint, "latest", latest)
    monkeypatch.setattr(TrainingRun, "run", checked_run)
    assert run("train", "-o", out, "--resume").code == 0


# Time budget


def test_minutes(run, dataset, tmp_path):
    out = tmp_path / "out"
    flags = ("--minutes", 0.03, "--eval", "--checkpoint-every", 40)
    result = run("train", dataset, "-o", out, *flags)
    assert result.code == 0, result.err
    lines = result.out.splitlines()
    assert re.fullmatch(r"1.8 s on this machine: 48x36, at most 1,037 Gaussians, .*steps", lines[1])
    assert any(re.fullmatch(r"\S+ s in total, of 1.8 s", line) for line in lines)
    assert any("views of 48x36  PSNR" in line for line in lines)
    step = json.loads((out / "metrics.json").read_text())["iteration"]
    assert len(scene(out, step)) > 1000
    training = json.loads((out / "config.json").read_text())["training"]
    assert training["iterations"] == step > 1
    assert training["density"]["max_gaussians"] == 1037

    # The training run is finished; --iterations adds steps to it.
    assert run("train", "-o", out, "--resume", "--iterations", step + 50).code == 0
    assert len(scene(out, step + 50)) > 1000


def test_a_resumed_run_keeps_its_time_budget(start, run, dataset, tmp_path):
    """The checkpoint has the time used so far and the adapted schedule."""
    out = tmp_path / "out"
    process = start("train", dataset, "-o", out, "--minutes", 2, "--checkpoint-every", 50)
    wait_for(out / "checkpoints/step_000200.safetensors", process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    newest = checkpoint.latest(out / "checkpoints")
    assert newest.meta["time"]["seconds"] == 120
    assert 0 < newest.meta["time"]["spent"] < 120
    assert newest.meta["schedule"]["iterations"] > newest.step
    result = run("train", "-o", out, "--resume", "--minutes", 0.03)
    assert result.code == 0, result.err
    assert f"step {newest.step} of {newest.meta['schedule']['iterations']}" in result.out
    assert "in total, of 1.8 s" in result.out


# Errors


def test_output_folders_with_other_files(refused, run, dataset, tmp_path):
    out = tmp_path / "out"
    out.write_text("a file")
    assert "is a file" in refused("train", dataset, "-o", out, *QUICK)
    out.unlink()
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    assert "contains other files" in refused("train", dataset, "-o", out, *QUICK)
    assert "contains other files" in refused("train", dataset, "-o", out, *QUICK, "--overwrite")
    assert files(out) == {"thesis.txt"}
    (out / "thesis.txt").unlink()
    assert run("train", dataset, "-o", out, *QUICK, "--checkpoint-every", 10).code == 0
    before = scene(out)
    assert "--resume" in refused("train", dataset, "-o", out, *QUICK)
    assert scene(out) == before
    (out / "notes.txt").write_text("mine")
    assert run("train", dataset, "-o", out, "--iterations", 20, "--overwrite").code == 0
    assert not (out / "checkpoints").exists()
    assert [p.name for p in (out / "point_cloud").iterdir()] == ["iteration_20"]
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--threads", 0], "--threads: 0 is too small; use a whole number of at least 1"),
        (["--minutes", 1e308], "--minutes: 1e+308 is not"),
        (["--position-lr-final", 0], "--lr-means-final: 0.0 is too small"),
        (["--recipe", "mcmc", "--densify-interval", 0], "--densify-interval: 0 is too small"),
        (["--minutes", 1, "--densify-interval", 0], "--densify-interval: 0 is too small"),
        (["--minutes", 1, "--iterations", 100], "cannot be combined"),
        (["--background", "black", "-w"], "different colours"),
        (["-s", "elsewhere"], "twice"),
        (["--test-list", "absent.txt"], "absent.txt"),
    ],
)
def test_invalid_flags(refused, dataset, tmp_path, flags, expected):
    assert expected in refused("train", dataset, "-o", tmp_path / "out", *flags)
    assert not (tmp_path / "out").exists()


def test_invalid_datasets_write_no_files(refused, dataset, tmp_path):
    out = tmp_path / "out"
    assert "no such folder" in refused("train", tmp_path / "absent", "-o", out)
    (tmp_path / "empty").mkdir()
    refused("train", tmp_path / "empty", "-o", out)
    damaged = tmp_path / "damaged"
    shutil.copytree(dataset, damaged)
    photos = sorted((damaged / "images").iterdir())
    for photo in photos:  # a few of them would be left out
        photo.write_bytes(b"not an image")
    assert photos[0].name in refused("train", damaged, "-o", out)
    shutil.rmtree(damaged)
    shutil.copytree(dataset, damaged)
    for photo in (damaged / "images").iterdir():  # detected only when they are decoded
        content = bytearray(photo.read_bytes())
        content[len(content) // 2] ^= 0xFF
        photo.write_bytes(content)
    assert "cannot be decoded" in refused("train", damaged, "-o", out, *QUICK, "-q")
    assert not out.exists()
    model = damaged / "sparse/0/images.bin"
    model.write_bytes(model.read_bytes()[:100])
    refused("train", damaged, "-o", out)
    assert "needs a dataset" in refused("train", "-o", out)
    assert "add -o" in refused("train", dataset)
    assert not out.exists()


def test_divergence_names_the_last_good_checkpoint(refused, run, dataset, tmp_path):
    """A scene can be saved from this checkpoint; no diverged value is stored."""
    out = tmp_path / "out"
    # The learning rate grows 60-fold per step, until it exceeds the range of float32.
    rates = ["--lr-means-final", 1e40, "--lr-means-steps", 25]
    # Antialiased Gaussians far away would be too transparent to be moved.
    rates += ["--antialias", "off"]
    line = refused("train", dataset, "-o", out, *QUICK, *rates, "--checkpoint-every", 3, "-q")
    diverged = int(re.search(r"step (\d+): non-finite .* means \(", line)[1])
    step = diverged // 3 * 3
    path = out / "checkpoints" / f"step_{step:06d}.safetensors"
    assert f"the last good checkpoint is {path}; use --resume with --iterations {step} " in line
    assert all(tensor.isfinite().all() for tensor in checkpoint.load(path).tensors.values())
    assert run("train", "-o", out, "--resume", "--iterations", step, "-q").code == 0
    assert read_gaussians(out / f"point_cloud/iteration_{step}/point_cloud.ply").usable_rows().all()
