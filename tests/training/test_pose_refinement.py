"""Camera poses that are optimised with the scene: coordinates, gradients, training, checkpoints."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, View
from snowsplat.data.load import load_dataset
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import Similarity, compose_rigid, invert_rigid, look_at
from snowsplat.scene.render import project
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts import pose_refinement
from snowsplat.training.parts.pose_coordinates import Gauge, after_motion, pixel_hessian, whitening
from snowsplat.training.parts.pose_refinement import PoseRefinement
from snowsplat.training.settings import TrainConfig
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.errors import UserError


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def noise(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def camera() -> Camera:
    pose = look_at(double(1.0, -0.5, -3.0), double(0.2, 0.1, 0.0), double(0.0, -1.0, 0.0))
    return Camera(60, 40, 50.0, 52.0, 31.0, 19.0, pose)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("poses")
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 17, 96, 72), hold_out=4)


def perturbed(dataset: Dataset, seed: int = 0) -> Dataset:
    """Each training camera turns by 1° and moves by 2% of the extent."""
    directions = noise(seed, len(dataset.train), 2, 3)
    directions = directions / directions.norm(dim=2, keepdim=True)
    sizes = double(1.0).deg2rad(), 0.02 * dataset.extent
    views = []
    for view, (turn, shift) in zip(dataset.train, directions, strict=True):
        motion = torch.cat([sizes[0] * turn, sizes[1] * shift])
        pose = after_motion(view.camera.cam_from_world, motion)
        views.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    return replace(dataset, train=views)


def test_a_motion_turns_the_camera_and_then_shifts_it() -> None:
    motion = double(0.3, -0.5, 0.2, 0.1, 0.2, -0.3)
    x, y, z = motion[:3].tolist()
    cross = torch.stack([double(0, -z, y), double(z, 0, -x), double(-y, x, 0)])
    pose = camera().cam_from_world
    expected = torch.linalg.matrix_exp(cross) @ pose
    expected[:, 3] += motion[3:]
    torch.testing.assert_close(after_motion(pose, motion), expected)
    assert torch.equal(after_motion(pose, torch.zeros(6, dtype=torch.float64)), pose)


def test_the_hessian_is_that_of_pixel_positions(dataset: Dataset) -> None:
    """By finite differences, over the points in the view."""
    view = dataset.train[0].camera
    assert dataset.points is not None
    points = dataset.points.xyz.double()
    pixel, depth = view.project(points)
    size = torch.tensor([view.width, view.height])
    seen = points[(depth > 0) & (pixel >= 0).all(1) & (pixel < size).all(1)]
    seen = seen[:: max(1, len(seen) // 500)]

    def pixels(numbers: Tensor) -> Tensor:
        factor = float(numbers[6].exp())
        pose = after_motion(view.cam_from_world, numbers[:6])
        other = replace(view, cam_from_world=pose, fx=factor * view.fx, fy=factor * view.fy)
        return other.project(seen)[0]

    steps = 1e-6 * torch.eye(7, dtype=torch.float64)
    j = torch.stack([(pixels(step) - pixels(-step)) / 2e-6 for step in steps], 2)
    expected = torch.einsum("pik,pil->kl", j, j) / len(seen)
    torch.testing.assert_close(pixel_hessian(view, dataset), expected, rtol=1e-5, atol=1e-3)


def test_without_points_the_hessian_is_that_of_a_grid(dataset: Dataset) -> None:
    hessian = pixel_hessian(dataset.train[0].camera, replace(dataset, points=None))
    assert bool((torch.linalg.eigvalsh(hessian[:6, :6]) > 0).all())


def test_one_unit_of_a_motion_is_about_a_pixel(dataset: Dataset) -> None:
    hessian = pixel_hessian(dataset.train[0].camera, dataset)[:6, :6]
    unit = whitening(hessian)
    in_pixels = (unit @ hessian @ unit).diagonal().sqrt()
    assert bool(((in_pixels > 0.3) & (in_pixels < 1.0)).all())


def test_the_gauge_is_that_of_similarity_transforms(dataset: Dataset) -> None:
    """The part of the motions of cameras of a scene that is moved and scaled is all of it."""
    cameras = [view.camera for view in dataset.train]
    units = torch.stack([whitening(pixel_hessian(c, dataset)[:6, :6]) for c in cameras])
    gauge = Gauge(cameras, units, dataset.extent)
    eps = 1e-6
    turn = after_motion(torch.eye(4, dtype=torch.float64)[:3], eps * noise(1, 6))
    similarity = Similarity(1.0 + 0.7 * eps, turn[:, :3], turn[:, 3])
    motions = []
    for each, unit in zip(cameras, units, strict=True):
        pose = similarity.apply_to_poses(each.cam_from_world)
        relative = (pose[:, :3] @ each.cam_from_world[:, :3].T - torch.eye(3).double()) / eps
        rotation = torch.stack([relative[2, 1], relative[0, 2], relative[1, 0]])
        turned = torch.linalg.cross(rotation, each.cam_from_world[:, 3])
        translation = (pose[:, 3] - each.cam_from_world[:, 3]) / eps - turned
        motions.append(torch.linalg.solve(unit, torch.cat([rotation, translation])))
    moves = torch.stack(motions)
    torch.testing.assert_close(gauge.part(moves), moves, rtol=1e-3, atol=1e-3)
    other = noise(2, len(moves), 6)
    part = gauge.part(other)
    assert float(part.norm()) < 0.7 * float(other.norm())
    torch.testing.assert_close(gauge.part(part), part)


@pytest.mark.isa
def test_the_gradient_of_a_motion(dataset: Dataset) -> None:
    """By finite differences of a function of the splats, in float64."""
    trainer = Trainer(dataset, TrainConfig(iterations=1, refine_poses=True))
    poses = trainer.part(PoseRefinement)
    assert poses is not None
    poses.state()["motions"][0] = 0.01 * noise(3, 6)
    scene = trainer.gaussians.to(dtype=torch.float64)
    scene = replace(scene, **{n: p[:50].clone() for n, p in scene.parameters().items()})
    trainer.gaussians = scene
    splats = project(scene, poses.camera(0), 0)
    assert splats.ids is not None
    cotangent = noise(4, *splats.packed.shape)
    cotangent[:, 7] = 0.0  # radii have no gradient
    splats.packed.grad = cotangent
    gradient = ViewGradient(splats, poses.camera(0), 0)
    d_motion, d_focal = poses._gradient(trainer, 0, gradient)

    def value(numbers: Tensor) -> float:
        shown = poses.camera(0)
        motion = poses._units[0] @ poses.state()["motions"][0] + numbers[:6]
        pose = after_motion(dataset.train[0].camera.cam_from_world, motion)
        factor = float(numbers[6].exp())
        other = replace(shown, cam_from_world=pose, fx=factor * shown.fx, fy=factor * shown.fy)
        seen = project(scene, other, 0)
        assert seen.ids is not None
        assert torch.equal(seen.ids, splats.ids)
        return float((seen.packed * cotangent).sum())

    steps = 1e-6 * torch.eye(7, dtype=torch.float64)
    expected = torch.tensor([(value(s) - value(-s)) / 2e-6 for s in steps], dtype=torch.float64)
    # To first order in the motion, which is about 0.01 pixels: 0.0002 radians.
    torch.testing.assert_close(
        d_motion, expected[:6], rtol=1e-3, atol=1e-2 * float(d_motion.abs().max())
    )
    torch.testing.assert_close(d_focal, expected[6], rtol=1e-6, atol=1e-6)


SHORT = {
    "iterations": 60,
    "init": "points",
    "densify_from": 10,
    "densify_interval": 10,
    "max_gaussians": 600,
}


def pixels_off(found: list[View], true: list[View], dataset: Dataset) -> float:
    """The mean error of the cameras in pixels, apart from a common similarity transform."""
    cameras = [view.camera for view in true]
    units = torch.stack([whitening(pixel_hessian(c, dataset)[:6, :6]) for c in cameras])
    motions = []
    for view, camera, unit in zip(found, cameras, units, strict=True):
        relative = compose_rigid(view.camera.cam_from_world, invert_rigid(camera.cam_from_world))
        turn = relative[:, :3]
        rotation = torch.stack(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        motions.append(torch.linalg.solve(unit, torch.cat([0.5 * rotation, relative[:, 3]])))
    whole = torch.stack(motions)
    own = whole - Gauge(cameras, units, dataset.extent).part(whole)
    return float(own.norm(dim=1).mean())


@pytest.mark.slow
def test_perturbed_poses_come_back(dataset: Dataset) -> None:
    wrong = perturbed(dataset)
    settings = recipe("default", iterations=250, max_gaussians=1500, test_iterations=())
    psnr, pixels = {}, {}
    for on in (False, True):
        trainer = Trainer(wrong, replace(settings, refine_poses=on))
        trainer.run()
        psnr[on] = trainer.evaluate().psnr
        pixels[on] = pixels_off(trainer.cameras.views(), dataset.train, dataset)
    assert pixels[True] < 0.75 * pixels[False]
    assert psnr[True] > psnr[False] + 0.5
    drift = trainer.part(PoseRefinement).drift()
    assert 0.1 < float(drift.rotations.median()) < 1.0
    assert 0.001 < float(drift.translations.median()) < 0.03
    assert "camera poses refined: rotation by 0." in str(drift.line)


def test_exact_poses_are_left_unchanged(dataset: Dataset, monkeypatch) -> None:
    """The training is that without refinement, to the bit."""
    monkeypatch.setattr(pose_refinement, "EXACT", 1.0)  # the scene of so few steps is blurred
    without = Trainer(dataset, recipe("default", **SHORT))
    trainer = Trainer(dataset, recipe("default", **SHORT, refine_poses=True))
    for each in (without, trainer):
        each.run()
    drift = trainer.part(PoseRefinement).drift()
    assert drift.exact
    assert "left unchanged" in str(drift.line)
    assert not drift.rotations.any()
    for name, tensor in without.state_tensors().items():
        assert torch.equal(trainer.state_tensors()[name], tensor), name


def test_without_refinement_the_cameras_are_those_of_the_dataset(dataset: Dataset) -> None:
    trainer = Trainer(dataset, recipe("default", **SHORT))
    trainer.run(until=5)
    assert not any(name.startswith("poses.") for name in trainer.state_tensors())
    assert trainer.cameras.views() is dataset.train
    assert trainer.cameras.test_views() is dataset.test


def test_resuming_is_bit_identical(dataset: Dataset, tmp_path: Path, monkeypatch) -> None:
    config = recipe("default", **SHORT, batch=4, refine_poses=True)
    monkeypatch.setattr(pose_refinement, "EXACT", 0.0)
    whole = Trainer(dataset, config)
    whole.run()
    first = Trainer(dataset, config)
    first.run(until=28)
    path = checkpoint.save(tmp_path, first.step, first.state_tensors(), {})
    second = Trainer(dataset, config, state=checkpoint.load(path).tensors)
    second.run()
    expected = whole.state_tensors()
    assert expected["poses.motions"].abs().min(1).values.max() > 0.0
    for name, tensor in second.state_tensors().items():
        assert torch.equal(tensor, expected[name]), name
    assert second.cameras.test_views()[0].camera.fx == whole.cameras.test_views()[0].camera.fx


def test_a_checkpoint_without_refined_poses_is_rejected(dataset: Dataset) -> None:
    state = Trainer(dataset, recipe("default", **SHORT)).state_tensors()
    with pytest.raises(UserError, match="another dataset or recipe"):
        Trainer(dataset, recipe("default", **SHORT, refine_poses=True), state=state)


def test_one_camera_does_not_move(dataset: Dataset) -> None:
    """Its only motion is that of the whole scene."""
    single = replace(dataset, train=dataset.train[:1])
    trainer = Trainer(single, recipe("default", **SHORT, refine_poses=True))
    trainer.run(until=30)
    assert float(trainer.part(PoseRefinement).drift().rotations.max()) < 1e-6
