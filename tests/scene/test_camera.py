"""The conventions of `Camera`: projection, scaling, gradients of the pose."""

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at

F64 = torch.float64


@pytest.fixture
def camera() -> Camera:
    pose = look_at(*(torch.tensor(v, dtype=F64) for v in ([1.0, 2, 3], [0.0, 0, 0], [0.0, 0, 1])))
    return Camera(641, 480, 500.0, 510.0, 320.25, 241.5, pose)


def test_position_and_inverse(camera):
    assert torch.allclose(camera.position, torch.tensor([1.0, 2, 3], dtype=F64))
    rotation, translation = camera.world_from_cam[:, :3], camera.world_from_cam[:, 3]
    there_and_back = camera.cam_from_world[:, :3] @ (
        rotation @ torch.ones(3, dtype=F64) + translation
    )
    assert torch.allclose(there_and_back + camera.cam_from_world[:, 3], torch.ones(3, dtype=F64))


def test_the_target_projects_to_the_principal_point(camera):
    position, depth = camera.project(torch.zeros(1, 3, dtype=F64))
    assert torch.allclose(position, torch.tensor([[320.25, 241.5]], dtype=F64))
    assert torch.allclose(depth, torch.tensor([14.0**0.5], dtype=F64))


def test_scaling_scales_projections(camera):
    points = torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    small = camera.scaled(320, 241)
    ratio = torch.tensor([320 / 641, 241 / 480], dtype=F64)
    assert torch.allclose(small.project(points)[0], camera.project(points)[0] * ratio)
    assert (camera.downscaled(4).width, camera.downscaled(4).height) == (160, 120)


def test_position_is_differentiable(camera):
    pose = camera.cam_from_world.clone().requires_grad_()
    Camera(8, 8, 10.0, 10.0, 4.0, 4.0, pose).position.sum().backward()
    assert pose.grad is not None
    assert pose.grad.abs().sum() > 0


@pytest.mark.parametrize("wrong", [{"width": 0}, {"fx": 0.0}, {"fy": float("nan")}])
def test_invalid_values_are_rejected(camera, wrong):
    fields = {name: getattr(camera, name) for name in Camera.__dataclass_fields__}
    with pytest.raises(ValueError, match="camera needs"):
        Camera(**{**fields, **wrong})
