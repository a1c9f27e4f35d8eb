"""The scene that `watch` shows."""

import shutil
from pathlib import Path

import pytest
import torch

from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.train import train
from snowsplat.pipeline.watch import NewestScene
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.training.core import checkpoint
from snowsplat.util.errors import UserError


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> Path:
    """Checkpoints of step 20 and 40, scenes of 20 and 50."""
    out = tmp_path_factory.mktemp("watch") / "out"
    settings = {"iterations": 50, "checkpoint_every": 20, "antialias": True}
    train(dataset, out, TrainOptions(settings=settings, save_iterations=(20,)))
    return out


def test_the_newest_scene_is_shown(trained, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(trained, out)
    folder = TrainingFolder(out)
    scene = NewestScene(folder, None)()
    assert scene.about[0].text("en") == "After 50 steps"
    assert NewestScene(folder, 20)().about[0].text("en") == "After 20 steps"
    with pytest.raises(UserError, match="no scene of iteration 7; there are 20, 50"):
        NewestScene(folder, 7)()

    shutil.rmtree(out / "point_cloud/iteration_50")
    newest = NewestScene(folder, None)
    of_checkpoint = newest()
    assert of_checkpoint.about[0].text("en") == "After 40 steps"
    tensors = checkpoint.latest(folder.checkpoints).tensors
    assert of_checkpoint.gaussians.means.equal(tensors["gaussians.means"])
    assert of_checkpoint.gaussians.antialiased
    assert scene.gaussians.antialiased
    assert newest() is of_checkpoint  # not read again

    # A newer scene appears, first damaged, then complete.
    path = folder.scene_path(50)
    path.parent.mkdir()
    path.write_bytes(b"ply\n")
    assert newest() is of_checkpoint
    shutil.copyfile(trained / "point_cloud/iteration_50/point_cloud.ply", path)
    later = newest()
    assert later.about[0].text("en") == "After 50 steps"
    assert later.number != of_checkpoint.number
    shutil.rmtree(out / "point_cloud")
    shutil.rmtree(out / "checkpoints")
    assert newest() is later  # as while the files are replaced
    assert NewestScene(folder, None)().gaussians is None
    assert "--checkpoint-every" in " ".join(map(str, NewestScene(folder, None)().about))


def test_a_checkpoint_of_something_else(trained, tmp_path):
    out = TrainingFolder(tmp_path / "out")
    shutil.copytree(trained, out.path)
    for tensors in ({"a": torch.zeros(3)}, {"gaussians.means": torch.zeros(3)}):
        checkpoint.save(out.checkpoints, 5000, tensors, {})
        with pytest.raises(UserError, match="not a checkpoint of a training run"):
            NewestScene(out, None)()
