"""`train`, `resume`, `evaluate` and `render` from Python: results, observer, errors."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch
from PIL import Image

from snowsplat.data import load
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output import image_files
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.render import evaluate, render_images
from snowsplat.pipeline.run.results import TrainingStopped
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.parts import transients, unexplained
from snowsplat.training.parts.unexplained import excluded_line
from snowsplat.util.errors import UserError


class Recorder(Observer):
    """Records the events of a training run, in order."""

    def __init__(self, interrupt_at: int = 0) -> None:
        self.events: list[str] = []
        self.notes: list[str] = []
        self.interrupt_at = interrupt_at

    def note(self, line: str) -> None:
        self.events.append("note")
        self.notes.append(str(line))

    def steps_begin(self, step: int, iterations: int) -> None:
        self.events.append(f"begin {step}/{iterations}")

    def step(self, progress) -> None:
        self.events.append(f"step {progress.step}")
        if progress.step == self.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)

    def steps_end(self) -> None:
        self.events.append("end")

    def trained(self, result) -> None:
        self.events.append("trained")


def options(steps: int, **changes) -> TrainOptions:
    return TrainOptions(settings={"iterations": steps}, **changes)


def damage(path: Path) -> None:
    """In the middle: detected only when the file is decoded."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def test_photos_damaged_in_the_middle_are_left_out(dataset, tmp_path, caplog):
    """A held-out one, one with such a mask, and another one."""
    folder, out = tmp_path / "d", tmp_path / "out"
    shutil.copytree(dataset, folder)
    photos = sorted((folder / "images").iterdir())
    mask = folder / "masks" / photos[2].name
    mask.parent.mkdir()
    with Image.open(photos[2]) as image:
        Image.effect_noise(image.size, 99).save(mask)
    for each in (photos[0], photos[1], mask):
        damage(each)
    train(folder, out, options(5, hold_out=4))
    names = [photo.name for photo in photos[:3]]
    assert f"3 of 9 photos are left out: {', '.join(names)}" in caplog.text
    found = {each.photo: (each.stage, str(each.reason)) for each in TrainingFolder(out).left_out()}
    assert found == dict.fromkeys(names, ("photos", "its data are damaged"))
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["left_out"], len(metrics["views"])) == (names, 2)


@pytest.fixture(scope="module")
def third_held_out(dataset, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("held_out") / "out"
    train(dataset, out, options(5, hold_out=3))
    return out


def test_held_out_photos_damaged_after_the_training(dataset, third_held_out, tmp_path):
    """The others are judged and rendered, under their own numbers."""
    folder, out = tmp_path / "d", tmp_path / "out"
    shutil.copytree(dataset, folder)
    shutil.copytree(third_held_out, out)
    (out / "config.json").write_text(
        (out / "config.json").read_text().replace(str(dataset), str(folder))
    )
    _, second, third = (view.image.path for view in load_trained(out).dataset.test)
    damage(second)
    judged = evaluate(load_trained(out))
    assert (len(judged.views), judged.unjudged) == (2, (second.name,))
    render_images(load_trained(out), splits=["test"])
    (written,) = out.rglob("gt")
    assert {file.name for file in written.iterdir()} == {"00000.png", "00002.png"}
    damage(third)
    with pytest.raises(UserError, match=f"{second.name}: cannot be decoded"):
        evaluate(load_trained(out))


def test_renderings_replace_others_at_once(third_held_out, tmp_path, monkeypatch):
    """Not if rendering is interrupted; images that are no longer made are gone."""
    out = shutil.copytree(third_held_out, tmp_path / "out")
    scene = load_trained(out)
    (folder,) = render_images(scene, splits=["test"], depth="16bit")
    (folder / "00099.png").touch()

    def files() -> dict[str, bytes]:
        return {str(f.relative_to(out)): f.read_bytes() for f in sorted(out.rglob("ours_5/**/*.*"))}

    before, left = files(), iter(range(3))

    def interrupted(*_) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(image_files, "write_png", interrupted)
        with pytest.raises(KeyboardInterrupt):
            render_images(scene, splits=["test"], depth="16bit")
    assert files() == before
    render_images(scene, splits=["test"])
    assert {*before} - {*files()} == {"test/ours_5/renders/00099.png"}
    assert not list(out.rglob(".snowsplat.new"))


def test_learnt_exposures_are_written(dataset, tmp_path):
    recorder, out = Recorder(), tmp_path / "out"
    settings = {"iterations": 5, "exposure": "on"}
    train(dataset, out, TrainOptions(settings=settings, hold_out=8), observer=recorder)
    assert any(note.startswith("exposure: photos differ by ") for note in recorder.notes)
    written = json.loads((out / "exposure.json").read_text())
    names = [view.name for view in load.load_dataset(dataset, hold_out=8).train]
    assert list(written["photos"]) == names
    assert abs(sum(red for red, _, _ in written["photos"].values())) < 1e-4
    assert "Exposures of the photos" in (out / "report.html").read_text(encoding="utf-8")


def test_from_a_dataset_to_metrics_and_images_without_printing(dataset, tmp_path, capfd):
    recorder, out = Recorder(), tmp_path / "out"
    result = train(dataset, out, options(5, hold_out=8), observer=recorder)
    assert recorder.events == [
        *("note", "note", "note", "note", "begin 0/5"),
        *(f"step {step}" for step in range(1, 6)),
        *("end", "trained"),
    ]
    assert "computing depth maps for the initialisation" in recorder.notes
    assert result.scene == out / "point_cloud/iteration_5/point_cloud.ply"
    assert result.scene.is_file()
    assert result.report.is_file()
    assert (result.step, result.first_step, result.time) == (5, 0, None)
    scene = load_trained(out)
    assert (len(scene.gaussians), scene.iteration) == (result.gaussians, 5)
    names = []
    evaluation = evaluate(scene, on_view=lambda metrics: names.append(metrics.name))
    assert names == ["view_00.png", "view_08.png"]
    assert result.evaluation is not None
    assert evaluation == result.evaluation[1]
    assert render_images(scene, splits=["test"]) == {out / "test/ours_5/renders": 2}
    assert capfd.readouterr() == ("", "")


def test_ctrl_c_and_resume_give_the_same_scene(dataset, tmp_path):
    whole = train(dataset, tmp_path / "whole", options(12))
    with pytest.raises(TrainingStopped, match="^stopped after step 7: ") as stopped:
        train(dataset, tmp_path / "out", options(12), observer=Recorder(interrupt_at=7))
    assert stopped.value.scene == tmp_path / "out/point_cloud/iteration_7/point_cloud.ply"
    recorder = Recorder()
    result = resume(tmp_path / "out", observer=recorder)
    assert "begin 7/12" in recorder.events
    assert (result.step, result.first_step) == (12, 7)
    assert result.scene.read_bytes() == whole.scene.read_bytes()
    with pytest.raises(UserError, match="other settings"):
        resume(tmp_path / "out", TrainOptions(settings={"seed": 3}))


def test_photos_that_are_left_out_are_named_also_by_a_resumed_run(dataset, tmp_path, monkeypatch):
    decided = []

    def unexplained_views(gaussians, views, images, **settings):
        decided.append([view.name for view in views])
        return 1, 3

    monkeypatch.setattr(unexplained, "unexplained_views", unexplained_views)
    settings = {"iterations": 12, "leave_out_after": 0.5}
    names = ("view_02.png", "view_04.png")
    line = (
        "2 photos are not explained by the scene and left out of the training: view_02.png, "
        "view_04.png; their camera poses are probably wrong"
    )

    recorder = Recorder(interrupt_at=9)
    with pytest.raises(TrainingStopped):
        train(dataset, tmp_path, TrainOptions(settings=settings, hold_out=8), observer=recorder)
    assert len(decided) == 1
    assert recorder.notes.count(line) == 1
    assert recorder.events.index("note", 4) == recorder.events.index("step 7") - 1

    recorder = Recorder()
    result = resume(tmp_path, observer=recorder)
    assert len(decided) == 1
    assert recorder.notes.count(line) == 1
    assert tuple(each.photo for each in result.left_out) == names
    assert json.loads((tmp_path / "metrics.json").read_text())["left_out"] == list(names)
    assert "probably wrong: view_02.png, view_04.png." in result.report.read_text()

    evaluate(load_trained(tmp_path), split="train")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["split"], metrics["left_out"]) == ("train", list(names))


def test_what_moves_is_masked_and_shown(dataset, tmp_path, monkeypatch):
    """In photos that are named here; tests/training/test_transients.py has what is found."""
    names = {"view_01.png", "view_04.png", "view_06.png"}

    def found(maps, before, mode):
        cells = [torch.zeros_like(each.usable) for each in maps]
        for i in (1, 4, 6):
            cells[i][1, 1:4] = True
        return cells

    monkeypatch.setattr(transients, "_moving_cells", found)
    settings = {"iterations": 40, "checkpoint_every": 25, "transients": "on"}
    recorder = Recorder()
    result = train(dataset, tmp_path / "out", TrainOptions(settings=settings), observer=recorder)
    moving = result.parts["transients"].facts
    assert set(moving) == names
    mean = 100 * sum(moving.values()) / 3
    line = f"something moves in 3 of 9 photos: masked there, {mean:.1f}% of their pixels; "
    assert recorder.notes.count(line + "see the report") == 1
    for name in moving:
        with Image.open(tmp_path / "out" / "masks" / f"{name}.png") as mask:
            assert mask.size == (48, 36)
            assert mask.histogram()[0] == round(moving[name] * 48 * 36) > 0
    report = result.report.read_text()
    assert "What moves" in report
    assert report.count(": masked parts") == 3 * 2  # alt and title

    recorder = Recorder()
    again = resume(tmp_path / "out", observer=recorder)
    assert again.parts["transients"].facts == moving
    assert recorder.notes.count(line + "see the report") == 1


def test_a_damaged_file_of_metrics_is_replaced(dataset, tmp_path):
    train(dataset, tmp_path, options(1, hold_out=8))
    whole = (tmp_path / "metrics.json").read_text()
    for damaged in ("", "[1]", '{"left_out": 3}'):
        (tmp_path / "metrics.json").write_text(damaged)
        evaluate(load_trained(tmp_path))
        assert (tmp_path / "metrics.json").read_text() == whole


@pytest.mark.parametrize(
    ("count", "expected"),
    [
        (1, "1 photo is not explained by the scene and left out of the training: 0.jpg; its camera "
            "pose is probably wrong"),
        (12, "12 photos are not explained by the scene and left out of the training: 0.jpg, 1.jpg, "
            "2.jpg, 3.jpg, 4.jpg, 5.jpg, 6.jpg, 7.jpg, 8.jpg, 9.jpg and 2 more; their camera poses "
            "are probably wrong"),
    ],
)  # fmt: skip
def test_the_line_about_photos_that_are_left_out(count, expected):
    assert str(excluded_line([f"{i}.jpg" for i in range(count)])) == expected


def test_a_time_budget_reads_the_dataset_once(tmp_path, monkeypatch):
    """The photos are downscaled, so there are two datasets; files are read only for the first."""
    dataset = write_toy_dataset(tmp_path / "dataset", "colmap-bin", 4, 480, 40, n_points=300)
    calls, read = [], load.read_poses

    def counted(*arguments):
        calls.append(arguments)
        return read(*arguments)

    monkeypatch.setattr(load, "read_poses", counted)
    result = train(dataset, tmp_path / "out", TrainOptions(minutes=0.01))
    assert len(calls) == 1
    assert result.time is not None
    assert result.time[1] == pytest.approx(0.6)
    settings = json.loads((tmp_path / "out/config.json").read_text())["dataset"]
    assert 200 <= settings["resolution"] < 480
