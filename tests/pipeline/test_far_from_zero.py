"""A dataset in UTM coordinates: where a scene and a dataset meet, and where cameras are written."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.data.colmap.model import posed_camera, read_model, read_points, write_model
from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.pipeline.blocks.plan import plan_blocks
from snowsplat.pipeline.blocks.train import merge_blocks, train_blocks
from snowsplat.pipeline.clean import clean
from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.options.benchmark import PlanOptions
from snowsplat.pipeline.options.scene import Edits
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import load_trained, load_viewable
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.train import train
from snowsplat.pipeline.watch import NewestScene
from snowsplat.scene.edit import seen_from
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.scene.origin import HERE, opposite

UTM = (500_000.0, 5_400_000.0, 300.0)
SETTINGS = {"iterations": 60, "init": "points", "refine_poses": True}


def positions(model: Path) -> torch.Tensor:
    """(V, 3) of the cameras of a COLMAP model."""
    found = read_model(model)
    return torch.stack([posed_camera(found, image).position for image in found.images])


@pytest.fixture(scope="module")
def far(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, moved in float64."""
    folder = shutil.copytree(dataset, tmp_path_factory.mktemp("far") / "far")
    model, points = read_model(folder / "sparse/0"), read_points(folder / "sparse/0")
    assert points is not None
    images = []
    for image in model.images:
        pose = posed_camera(model, image).seen_from(opposite(UTM)).cam_from_world
        numbers = (*quat_from_rotation(pose[:, :3]).tolist(), *pose[:, 3].tolist())
        images.append(replace(image, pose=numbers))
    xyz = points.xyz.double().numpy() + UTM
    write_model(folder / "sparse/0", model.cameras, images, xyz, points.rgb.numpy())
    return folder


@pytest.fixture(scope="module")
def out(far: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "out"
    train(far, out, TrainOptions(settings=SETTINGS, hold_out=4))
    return out


def test_refined_cameras_are_those_of_the_files(far: Path, out: Path) -> None:
    """They are as exact as near 0, and keep the near plane."""
    apart = positions(out / "refined/sparse/0") - positions(far / "sparse/0")
    assert float(apart.norm(dim=1).max()) < 0.2
    refined, given = load_trained(out).dataset, load_dataset(far, hold_out=4)
    assert refined.origin == given.origin != HERE
    for new, old in zip(refined.test, given.test, strict=True):  # these are not refined
        torch.testing.assert_close(new.camera.cam_from_world, old.camera.cam_from_world)
        assert new.camera.near == old.camera.near
    assert all(view.camera.near == given.train[0].camera.near for view in refined.train)


def test_a_scene_of_another_origin_meets_the_dataset(far: Path, out: Path, tmp_path: Path) -> None:
    """Positions in doubles get an origin near their own median."""
    before = evaluate(load_trained(out)).psnr
    other = shutil.copytree(out, tmp_path / "out")
    scene = other / "point_cloud/iteration_60/point_cloud.ply"
    convert(scene, tmp_path / "local.ply", Edits(translate=(0.0, 0.0, 40.0)))
    convert(tmp_path / "local.ply", tmp_path / "moved.ply", Edits(translate=(0.0, 0.0, -40.0)))
    shutil.copy(tmp_path / "moved.ply", scene)
    origin = load_dataset(far).origin
    assert read_gaussians(scene).origin not in (origin, HERE)
    trained = load_trained(other)
    assert trained.gaussians.origin == origin
    assert evaluate(trained).psnr == pytest.approx(before, abs=0.01)
    shown = NewestScene(trained.folder, None, origin=origin)().gaussians
    assert shown is not None
    torch.testing.assert_close(shown.means, trained.gaussians.means)
    cleaned = clean(scene, tmp_path / "cleaned.spz", dataset=far)
    assert cleaned.after > 0.5 * cleaned.before
    assert cleaned.psnr[0] == pytest.approx(before, abs=0.01)
    assert read_gaussians(tmp_path / "cleaned.spz").origin == origin
    saved = read_gaussians(out / "point_cloud/iteration_60/point_cloud.ply")
    write_gaussians(scene, replace(saved, origin=HERE))  # as another program saves it
    assert evaluate(load_trained(other)).psnr == pytest.approx(before, abs=0.01)
    for stored in (saved, replace(saved, origin=HERE), seen_from(saved, (500_001.0, *UTM[1:]))):
        write_gaussians(scene, stored)  # the cameras in the output folder see the same
        assert load_viewable(other).gaussians.origin == origin
        torch.testing.assert_close(load_viewable(other).gaussians.means, saved.means)
    shutil.copy(tmp_path / "moved.ply", scene)
    convert(scene, tmp_path / "half.ply", Edits(decimate="50%"), dataset=far)
    shutil.copy(tmp_path / "half.ply", scene)
    assert evaluate(load_trained(other)).psnr > before - 1


def test_blocks(far: Path, tmp_path: Path) -> None:
    settings = {"iterations": 60, "init": "points"}
    plan = plan_blocks(far, tmp_path, PlanOptions(blocks=2, settings=settings, hold_out=4))
    assert plan.origin == load_dataset(far).origin
    whole = positions(far / "sparse/0")
    for block in plan.blocks:
        own = positions(tmp_path / block.name / "dataset/sparse/0")
        assert float(torch.cdist(own, whole).min(dim=1).values.max()) < 1e-5
    train_blocks(tmp_path)
    merged = merge_blocks(tmp_path)
    assert read_gaussians(merged.scene).origin == plan.origin
    assert evaluate(load_trained(tmp_path)).psnr > 15
