"""A decimated scene is trained again on its photos."""

import shutil

import pytest

from snowsplat.data import load_dataset
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.convert import convert, transform_of
from snowsplat.pipeline.options.scene import Edits
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import cameras_of
from snowsplat.pipeline.train import train
from snowsplat.project.project import Project
from snowsplat.scene import edit
from snowsplat.scene.render import render
from snowsplat.util.errors import SettingError


def test_the_photos_improve_a_decimated_scene(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("snowsplat.pipeline.convert._REFINED_STEPS", 40)
    train(dataset, tmp_path / "out", TrainOptions(settings={"iterations": 60}))
    count = len(read_gaussians(tmp_path / "out/point_cloud/iteration_60/point_cloud.ply")) // 3
    plain, refined = tmp_path / "plain.ply", tmp_path / "refined.ply"
    convert(tmp_path / "out", plain, Edits(decimate=count))
    convert(tmp_path / "out", refined, Edits(decimate=count), dataset=dataset)
    views = load_dataset(dataset, hold_out=None).train
    before, after = (evaluate_views(read_gaussians(path), views).psnr for path in (plain, refined))
    assert after > before + 1.0
    assert len(read_gaussians(refined)) == len(read_gaussians(plain)) == count


def test_edits_that_hide_a_part_are_refused(dataset, tmp_path):
    (tmp_path / "a.ply").touch()
    for edits in (
        Edits(),
        Edits(decimate=9, crop=(0, 0, 0, 1, 1, 1)),
    ):
        with pytest.raises(SettingError) as error:
            convert(tmp_path / "a.ply", tmp_path / "b.ply", edits, dataset=dataset)
        assert error.value.setting == "refine"


def test_the_cameras_of_an_output_folder_are_used(dataset, tmp_path):
    out = tmp_path / "out"
    train(dataset, out, TrainOptions(settings={"iterations": 60}))
    file = out / "point_cloud/iteration_60/point_cloud.ply"
    whole, bare = read_gaussians(file), tmp_path / "bare.ply"
    shutil.copy(file, bare)
    _, cameras = cameras_of(Project.open(out).training)
    wanted = [render(whole, camera).image for camera in cameras]

    def loss(source, edits):
        """The mean error against the whole scene, of what `convert` makes of ``source``."""
        convert(source, tmp_path / "small.ply", edits, overwrite=True)
        found = read_gaussians(tmp_path / "small.ply")
        assert len(found) == len(whole) // 3
        transform = transform_of(edits)
        if transform:
            found = edit.transform(found, transform.inverse())
        images = [render(found, camera).image for camera in cameras]
        return sum(float((a - b).abs().mean()) for a, b in zip(images, wanted, strict=True))

    count = len(whole) // 3
    distilled = loss(out, Edits(decimate=count))
    assert distilled < 0.8 * loss(bare, Edits(decimate=count))
    # Training is chaotic: the rounding of the transform changes its result a little.
    moved = loss(out, Edits(decimate=count, scale=0.01, translate=(0.0, 0.0, 0.5)))
    assert moved == pytest.approx(distilled, rel=0.05)
