"""A training whose folder or dataset was moved, and photos that are edited before `resume`."""

import os
import shutil

import pytest
from PIL import Image, ImageOps

from snowsplat.pipeline import make
from snowsplat.pipeline.make_plan import MakePlan
from snowsplat.pipeline.observer import SILENT
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import load_dataset_of
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.sfm.ingest.search.sources import Sources
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError
from snowsplat.util.stages import Outcome, Stages

_SETTINGS = {"max_gaussians": 200, "init": "points", "checkpoint_every": 2}


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A dataset and its training, side by side."""
    project = tmp_path_factory.mktemp("first") / "project"
    write_toy_dataset(project / "dataset", n_views=6)
    train(project / "dataset", project / "scene", TrainOptions(settings=_longer(2)))
    return project


def _longer(iterations):
    return {**_SETTINGS, "iterations": iterations}


def _dataset_of(out):
    return load_dataset_of(TrainingFolder(out))[0].train[0].image.path.parents[1]


def test_moved_folders(project, tmp_path, caplog):
    caplog.set_level("INFO", logger="snowsplat")
    # A dataset beside a folder named scene, as `make` has it: the copy belongs to the copy.
    copy = shutil.copytree(project, tmp_path / "copy")
    assert _dataset_of(copy / "scene") == copy / "dataset"
    assert _dataset_of(project / "scene") == project / "dataset"
    # Only the output was moved.
    shutil.copytree(project / "scene", tmp_path / "a" / "scene")
    assert _dataset_of(tmp_path / "a" / "scene") == project / "dataset"
    # Of other names, a path that exists is never replaced; one that does not is, and it is said.
    other = tmp_path / "other"
    (copy / "dataset").rename(copy / "photos")
    train(copy / "photos", copy / "out", TrainOptions(settings=_longer(2)))
    shutil.copytree(copy, other)
    assert _dataset_of(other / "out") == copy / "photos"
    assert "was moved" not in caplog.text
    shutil.rmtree(copy)
    assert _dataset_of(other / "out") == other / "photos"
    assert "was moved; photos is read from" in caplog.text
    resume(other / "out", TrainOptions(settings={"iterations": 4}))
    assert TrainingFolder(other / "out").scenes() == [2, 4]


def test_edited_photos(project, tmp_path, caplog):
    copy = shutil.copytree(project, tmp_path / "copy")
    dataset, out = copy / "dataset", copy / "scene"
    photos = sorted((dataset / "images").iterdir())
    os.utime(photos[1], (1.0, 1.0))
    resume(out, TrainOptions(settings={"iterations": 4}))
    assert "edited" not in caplog.text  # only the time of the file has changed
    ImageOps.invert(Image.open(photos[0]).convert("RGB")).save(photos[0])
    resume(out, TrainOptions(settings={"iterations": 6}))
    [warning] = [line for line in caplog.messages if "edited" in line]
    said = "1 of 6 photos and masks were edited after the first step"
    assert said in warning
    assert f"images/{photos[0].name}" in warning
    assert "edited after the first step" in (out / "report.html").read_text(encoding="utf-8")
    caplog.clear()
    resume(out, TrainOptions(settings={"iterations": 8}))
    assert "edited" not in caplog.text  # it is said once


@pytest.mark.parametrize(
    ("recorded", "same", "name"),
    [("old", True, "old"), ("old", False, "new"), ("../old", True, "new"), (None, True, "new")],
)
def test_make_keeps_its_name_if_only_the_photos_were_renamed(
    recorded, same, name, tmp_path, monkeypatch
):
    done = {"photos": Outcome({}, 0.0, same)}
    monkeypatch.setattr(make, "make_dataset", lambda *args, **flags: done)
    stages, sources = Stages(tmp_path / "make.json", make.STAGES), Sources((tmp_path,), [], [], [])
    stages.about = {"name": recorded}
    inputs = tmp_path, "new", sources, None, stages
    job = make._Job(*inputs, make.MakeOptions(), False, SILENT, None, 0.0)
    job._make_dataset(MakePlan("draft", 900))
    assert (job.file, job.stages.about["name"]) == (tmp_path / f"{name}.ply", name)


def test_make_leaves_the_comparison_of_photos_to_their_dataset(tmp_path):
    """Their folder may have been renamed. Without a dataset, the scene may be that of another."""
    sources, stages = Sources((tmp_path,), [], [], []), Stages(tmp_path / "make.json", make.STAGES)
    stages.about = {"inputs": ["/old"]}
    with pytest.raises(UserError, match="contains a scene made from /old"):
        make._check_inputs(tmp_path, sources, stages, overwrite=False)
    (tmp_path / "dataset").mkdir()
    make._check_inputs(tmp_path, sources, stages, overwrite=False)
    assert stages.about["inputs"] == [str(tmp_path)]
