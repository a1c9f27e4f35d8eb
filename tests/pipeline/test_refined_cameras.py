"""Training with refined cameras: the lines, the files, and what uses them later."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.run.results import TrainResult
from snowsplat.pipeline.run.training_files import with_refined, write_refined
from snowsplat.pipeline.train import train
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.training.parts import pose_refinement
from snowsplat.util.errors import UserError


def options(**settings) -> TrainOptions:
    changes = {"iterations": 60, "init": "points"} | settings
    return TrainOptions(settings=changes, hold_out=4, resolution=24)


@pytest.fixture(scope="module")
def out(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("refined") / "out"


@pytest.fixture(scope="module")
def result(dataset: Path, out: Path) -> Iterator[TrainResult]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_refinement, "EXACT", 0.0)  # the poses are exact
        yield train(dataset, out, options(refine_poses=True))


def test_the_drift_is_reported(result: TrainResult) -> None:
    (line,) = result.parts["poses"].lines
    assert str(line).startswith("camera poses refined: rotation by ")
    assert "Camera poses refined: rotation by" in result.report.read_text(encoding="utf-8")


def test_the_model_is_a_dataset_with_refined_cameras(
    dataset: Path, out: Path, result: TrainResult, tmp_path: Path
) -> None:
    """At the full size of the photos. Held-out photos keep their poses."""
    shutil.copytree(dataset / "images", tmp_path / "images")
    shutil.copytree(out / "refined" / "sparse", tmp_path / "sparse")
    first, refined = (load_dataset(folder, hold_out=4) for folder in (dataset, tmp_path))
    assert first.points is not None
    assert refined.points is not None
    assert torch.equal(refined.points.xyz, first.points.xyz)
    assert [view.name for view in refined.train] == [view.name for view in first.train]
    for a, b in zip(first.test, refined.test, strict=True):
        torch.testing.assert_close(a.camera.cam_from_world, b.camera.cam_from_world)
        assert a.camera.width == b.camera.width == 48
        assert 0.9 < b.camera.fx / a.camera.fx < 1.1
    for a, b in zip(first.train, refined.train, strict=True):
        moved = (a.camera.cam_from_world - b.camera.cam_from_world).abs().max()
        assert 1e-7 < float(moved) < 0.2
        assert b.camera.fx == refined.test[0].camera.fx


def test_cameras_json_has_the_refined_cameras(out: Path, result: TrainResult) -> None:
    trained = load_trained(out)
    written = {c["img_name"]: c for c in json.loads((out / "cameras.json").read_text())}
    for view in [*trained.dataset.train, *trained.dataset.test]:
        entry = written[Path(view.name).stem]
        position = torch.tensor(entry["position"], dtype=torch.float64)
        torch.testing.assert_close(view.camera.position, position, rtol=0, atol=1e-9)
        assert entry["fx"] == pytest.approx(view.camera.fx)


def test_the_evaluation_uses_them(out: Path, result: TrainResult) -> None:
    assert result.evaluation is not None
    again = evaluate(load_trained(out))
    assert again.psnr == pytest.approx(result.evaluation[1].psnr, abs=1e-3)


def test_a_run_without_refinement_removes_them(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    train(dataset, out, options(refine_poses=True, iterations=3))
    assert (out / "refined/sparse/0/images.bin").is_file()
    result = train(dataset, out, options(iterations=3), overwrite=True)
    assert not (out / "refined").exists()
    assert "poses" not in result.parts


def test_a_photo_that_is_not_in_the_model(dataset: Path, tmp_path: Path) -> None:
    whole = load_dataset(dataset, hold_out=4)
    write_refined(TrainingFolder(tmp_path), whole.train, whole)
    with pytest.raises(UserError, match=r"no camera for view_00\.png"):
        with_refined(TrainingFolder(tmp_path), whole)
    same = with_refined(TrainingFolder(tmp_path), replace(whole, test=[]))
    for a, b in zip(whole.train, same.train, strict=True):
        torch.testing.assert_close(a.camera.cam_from_world, b.camera.cam_from_world)
