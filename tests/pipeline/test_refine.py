"""A decimated scene is trained again on its photos."""

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.convert import Edits, convert
from snowsplat.pipeline.scene_source import cameras_of, training_folder
from snowsplat.pipeline.train import TrainOptions, train
from snowsplat.scene.simplify import simplify
from snowsplat.util.errors import SettingError


def test_the_photos_improve_a_decimated_scene(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("snowsplat.pipeline.refine._STEPS", 40)
    train(dataset, tmp_path / "out", TrainOptions(settings={"iterations": 60}))
    count = len(read_gaussians(tmp_path / "out/point_cloud/iteration_60/point_cloud.ply")) // 3
    plain, refined = tmp_path / "plain.ply", tmp_path / "refined.ply"
    convert(tmp_path / "out", plain, Edits(decimate=count))
    convert(tmp_path / "out", refined, Edits(decimate=count), dataset=dataset)
    views = load_dataset(dataset, hold_out=None).train
    before, after = (evaluate_views(read_gaussians(path), views).psnr for path in (plain, refined))
    assert after > before + 1.0
    assert len(read_gaussians(refined)) == len(read_gaussians(plain)) == count


def test_edits_that_move_the_scene_are_refused(dataset, tmp_path):
    for edits in (
        Edits(),
        Edits(decimate=9, scale=2.0),
        Edits(decimate=9, crop=(0, 0, 0, 1, 1, 1)),
    ):
        with pytest.raises(SettingError) as error:
            convert(tmp_path / "a.ply", tmp_path / "b.ply", edits, dataset=dataset)
        assert error.value.setting == "refine"


def test_the_cameras_of_an_output_folder_are_used(dataset, tmp_path):
    train(
        dataset, tmp_path / "out", TrainOptions(settings={"iterations": 20, "max_gaussians": 2000})
    )
    whole = read_gaussians(tmp_path / "out/point_cloud/iteration_20/point_cloud.ply")
    count, cameras = len(whole) // 2, cameras_of(training_folder(tmp_path / "out"))
    for edits, known in (
        (Edits(decimate=count), cameras),
        (Edits(decimate="50%"), cameras),
        (Edits(decimate=count, translate=(0.0, 0.0, 0.5)), []),  # the cameras are not there
    ):
        convert(tmp_path / "out", tmp_path / "small.ply", edits, overwrite=True)
        found = read_gaussians(tmp_path / "small.ply")
        expected = simplify(whole, len(found), known)
        expected.means += torch.tensor(edits.translate)
        torch.testing.assert_close(found.means, expected.means, rtol=1e-3, atol=1e-3)
    other = simplify(whole, count, [])
    assert not torch.equal(other.means, simplify(whole, count, cameras).means)
