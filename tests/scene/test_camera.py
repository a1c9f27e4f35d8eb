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


def test_points_are_projected_by_the_pose_then_the_focal_lengths(camera):
    points = torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    x, y, z = camera.cam_from_world[:, :3] @ points.T + camera.cam_from_world[:, 3:]
    expected = torch.stack([500.0 * x / z + 320.25, 510.0 * y / z + 241.5], 1)
    torch.testing.assert_close(camera.project(points), (expected, z))


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


def test_a_pose_has_three_rows_and_four_columns(camera):
    for shape in ((4, 4), (3, 3), (1, 3, 4)):
        with pytest.raises(ValueError, match="cam_from_world"):
            Camera(8, 8, 10.0, 10.0, 4.0, 4.0, torch.zeros(shape))
    assert Camera(1, 1, 1e-9, 1e-9, 4.0, 4.0, camera.cam_from_world).width == 1
    with pytest.raises(ValueError, match="size"):
        Camera(8, 0, 10.0, 10.0, 4.0, 4.0, camera.cam_from_world)


@pytest.mark.parametrize("field", ["fx", "fy", "cx", "cy", "cam_from_world"])
@pytest.mark.parametrize("value", [1e39, float("inf")])
def test_every_number_must_be_finite_in_single_precision(camera, field, value):
    fields = {name: getattr(camera, name) for name in Camera.__dataclass_fields__}
    assert camera.is_finite()
    if field == "cam_from_world":
        value = torch.full((3, 4), value, dtype=F64)
    assert not Camera(**{**fields, field: value}).is_finite()
    if field in ("cx", "cy"):
        assert not Camera(**{**fields, field: -1e39}).is_finite()


def test_downscaling_rounds_down_to_at_least_one_pixel(camera):
    half = camera.downscaled(2)
    assert (half.width, half.height) == (320, 240)
    assert half.fx == pytest.approx(500 * 320 / 641)
    assert (half.fy, half.cy) == (255, 120.75)
    assert half.cx == pytest.approx(320.25 * 320 / 641)
    tiny = camera.downscaled(1000)
    assert (tiny.width, tiny.height) == (1, 1)


def test_to_moves_the_pose_alone(camera):
    moved = camera.to(torch.device("cpu"))
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    assert [getattr(moved, f) for f in fields] == [getattr(camera, f) for f in fields]
    assert torch.equal(moved.cam_from_world, camera.cam_from_world)
    assert camera.to(torch.device("meta")).cam_from_world.device.type == "meta"


def test_points_are_projected_in_their_own_precision(camera):
    for dtype in (torch.float32, F64):
        position, depth = camera.project(torch.zeros(2, 3, dtype=dtype))
        assert position.dtype == depth.dtype == dtype
