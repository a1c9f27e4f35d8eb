"""What belongs together in a folder: by the place of the files, or by the record of `make`."""

import json
import shutil
from dataclasses import asdict

import pytest

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.edit_record import EditRecord, edited_file, record_file
from snowsplat.project.left_out import LeftOut
from snowsplat.project.project import Project, is_output
from snowsplat.project.training_folder import UNEXPLAINED, DatasetSettings, TrainingFolder
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

TRAINING = {"sh_degree": 3, "background": "white", "iterations": 7}


@pytest.fixture
def made(tmp_path):
    """A folder of `make`: a training with two scenes, and the scene with a title."""
    folder = tmp_path / "garden_scene"
    training = TrainingFolder(folder / "scene")
    training.write_settings(DatasetSettings(str(folder / "dataset")), TRAINING)
    for step in (3, 7):
        training.scene_path(step).parent.mkdir(parents=True)
        training.scene_path(step).write_text(str(step))
    write_record(folder, file="garden.ply", title="My garden")
    (folder / "garden.ply").write_text("all")
    return folder


def write_record(folder, **about):
    (folder / "make.json").write_text(json.dumps({**about, "stages": {}}))


def test_folder_of_make_and_its_parts(made):
    project = Project.open(made)
    assert project.scene == made / "garden.ply"
    assert project.training_folder().path == made / "scene"
    assert project.name == Project.open(made / "scene").name == "My garden"
    assert Project.open(made / "scene").home == made
    assert project.dataset.path == Project.open(made / "scene").dataset.path == made / "dataset"
    assert not project.is_file
    # The folder of the training is asked for the scene of the training.
    assert Project.open(made / "scene").scene == project.training_folder().scene_path(7)
    assert Project.open(made, 3).scene == project.training_folder().scene_path(3)
    with pytest.raises(UserError, match="no scene of iteration 4; there are 3, 7"):
        Project.open(made, 4)


@pytest.mark.parametrize("name", ["garden.ply", "scene/point_cloud/iteration_3/point_cloud.ply"])
def test_scene_file_knows_its_training_also_in_a_renamed_folder(made, name):
    moved = made.rename(made.with_name("moved"))
    project = Project.open(moved / name)
    assert project.is_file
    assert project.training == TrainingFolder(moved / "scene")
    assert project.training.settings()[0].path == str(made / "dataset")  # it does not exist
    (moved / "dataset").mkdir()
    assert project.training.settings()[0].path == str(moved / "dataset")
    assert project.training.background() == (1.0, 1.0, 1.0)
    with pytest.raises(UserError, match="`iteration` selects"):
        Project.open(moved / name, 3)


def test_another_file_beside_the_scene_has_no_training(made):
    other = made / "other.ply"
    shutil.copy(made / "scene/point_cloud/iteration_7/point_cloud.ply", other)
    project = Project.open(other)
    assert (project.scene, project.training, project.name) == (other, None, "other")
    with pytest.raises(UserError, match=r"other\.ply: is a file"):
        project.training_folder()


def test_edited_scene_has_the_training_of_the_original(made):
    edited = edited_file(made / "garden.ply")
    edited.write_text("edited")
    record_file(edited).write_text(json.dumps(asdict(EditRecord("garden.ply", 5, scale=2.0))))
    project = Project.open(edited)
    # Its world may be another one, so the cameras of the training are not its own.
    assert project.training is None
    assert project.original.training == TrainingFolder(made / "scene")
    assert (project.original.scene, project.name) == (made / "garden.ply", "garden")
    assert not project.has_seen_all_photos


def test_after_the_last_part_no_photo_judges_the_scene(made):
    scene, evaluated = made / "garden.ply", made / "scene/point_cloud/iteration_7/point_cloud.ply"
    assert not Project.open(scene).has_seen_all_photos
    write_record(made, file="garden.ply", last_part=True)
    assert Project.open(scene).has_seen_all_photos
    assert Project.open(made).has_seen_all_photos
    assert not Project.open(evaluated).has_seen_all_photos


@pytest.mark.parametrize("record", ["{", "[]", '{"file": 5, "title": []}', '{"file": "../x.ply"}'])
def test_damaged_record_of_make(made, record):
    (made / "make.json").write_text(record)
    project = Project.open(made)
    assert project.scene == project.training_folder().scene_path(7)
    assert project.name == "garden_scene"


def test_photos_that_were_left_out_at_every_stage(made):
    dataset = DatasetFolder(made / "dataset")
    dataset.path.mkdir()
    unreadable = [
        LeftOut("/p", "photos", why) for why in (message("a broken link"), message("is empty"))
    ]
    results = {
        "photos": {"left_out": [asdict(each) for each in unreadable]},
        "poses": {"unregistered": {"2.jpg": "it matches no other photo"}},
    }
    stages = {name: {"result": result} for name, result in results.items()}
    dataset.record.write_text(json.dumps({"stages": stages}))
    training = TrainingFolder(made / "scene")
    unexplained = LeftOut("3.jpg", "training", UNEXPLAINED)
    training.write_metrics(7, "test", {"psnr": 20.0}, [unexplained])
    assert Project.open(made).left_out == [
        *unreadable,
        LeftOut("2.jpg", "poses", message("it matches no other photo")),
        unexplained,
    ]
    training.write_metrics(7, "train", {"psnr": 21.0})  # the list is kept
    assert training.left_out() == [unexplained]
    assert training.read_metrics()["split"] == "train"
    training.metrics.write_text('{"left_out": 5}')
    dataset.record.write_text('{"stages": {"photos": {"result": {"left_out": [5]}}}}')
    assert Project.open(made).left_out == []


def test_what_is_no_project(tmp_path):
    for path in (tmp_path, tmp_path / "absent"):
        project = Project.open(path)
        assert project.scene is None
        with pytest.raises(UserError, match=r"contains no scene|no such file or folder"):
            project.scene_file()
    assert not is_output(tmp_path)
    with pytest.raises(UserError, match="no such folder; give the output folder"):
        Project.open(tmp_path / "absent").training_folder()


def test_outputs_of_this_program_are_known(made):
    assert is_output(made)
    assert is_output(made / "scene")
    DatasetFolder(made).record.touch()
    (made / "make.json").unlink()
    assert is_output(made)
