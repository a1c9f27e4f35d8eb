"""Rotations and rigid transforms: round trips, the hard half turns, gradients, conventions."""

import math

import pytest
import torch

from snowsplat.geometry import (
    compose_rigid,
    invert_rigid,
    look_at,
    quat_from_rotation,
    rotation_from_quat,
    transform_points,
)

F64 = torch.float64


def random_quats(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 4, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_quarter_turn_about_z_takes_x_to_y():
    half = math.pi / 4
    rotation = rotation_from_quat(torch.tensor([math.cos(half), 0, 0, math.sin(half)], dtype=F64))
    assert torch.allclose(
        rotation @ torch.tensor([1.0, 0, 0], dtype=F64), torch.tensor([0.0, 1, 0], dtype=F64)
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-6), (F64, 1e-14)])
def test_rotations_are_orthonormal_for_quaternions_of_any_length(dtype, tolerance):
    rotations = rotation_from_quat((random_quats(100) * 7).to(dtype))
    identity = torch.eye(3, dtype=dtype).expand(100, 3, 3)
    assert torch.allclose(rotations @ rotations.mT, identity, atol=tolerance)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(100, dtype=dtype), atol=tolerance)


def test_quaternion_round_trip():
    quats = random_quats(500).reshape(2, 250, 4)
    quats = quats / quats.norm(dim=-1, keepdim=True)
    quats = torch.where(quats[..., :1] < 0, -quats, quats)
    back = quat_from_rotation(rotation_from_quat(quats))
    assert back.shape == (2, 250, 4)
    assert torch.allclose(back, quats, atol=1e-14)


@pytest.mark.parametrize(
    "axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 2, 3]]
)
@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi - 1e-9, math.pi])
def test_round_trip_of_rotations_near_none_and_half_turns(axis, angle):
    direction = torch.tensor(axis, dtype=F64)
    direction = direction / direction.norm()
    quat = torch.cat(
        [torch.tensor([math.cos(angle / 2)], dtype=F64), direction * math.sin(angle / 2)]
    )
    rotation = rotation_from_quat(quat)
    assert torch.allclose(rotation_from_quat(quat_from_rotation(rotation)), rotation, atol=1e-12)


def test_zero_quaternion_is_the_identity_with_finite_gradient():
    quat = torch.zeros(4, dtype=F64, requires_grad=True)
    rotation = rotation_from_quat(quat)
    assert torch.equal(rotation.detach(), torch.eye(3, dtype=F64))
    rotation.sum().backward()
    assert torch.isfinite(quat.grad).all()


def test_gradients():
    quats = random_quats(4, 1).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_quat, quats)
    # The inverse too, near half turns and in general.
    near_half_turns = torch.eye(4, dtype=F64)[1:] + 0.01
    for start in (quats.detach(), near_half_turns):
        assert torch.autograd.gradcheck(
            lambda q: quat_from_rotation(rotation_from_quat(q)), start.clone().requires_grad_()
        )


def rigid(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    translation = torch.randn(3, 3, 1, generator=generator, dtype=F64)
    return torch.cat([rotation_from_quat(random_quats(3, seed)), translation], -1)


def test_rigid_inverse_and_composition():
    a_from_b, b_from_c = rigid(1), rigid(2)
    points = torch.randn(3, 5, 3, dtype=F64, generator=torch.Generator().manual_seed(3))
    direct = transform_points(a_from_b, transform_points(b_from_c, points))
    assert torch.allclose(transform_points(compose_rigid(a_from_b, b_from_c), points), direct)
    identity = torch.eye(4, dtype=F64)[:3].expand(3, 3, 4)
    assert torch.allclose(compose_rigid(invert_rigid(a_from_b), a_from_b), identity, atol=1e-12)


def test_look_at_puts_the_target_ahead_and_up_above():
    position = torch.tensor([3.0, -2.0, 1.0], dtype=F64)
    target = torch.tensor([0.5, 0.5, 0.0], dtype=F64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    pose = look_at(position, target, up)
    ahead, above = transform_points(pose, torch.stack([target, target + 0.1 * up]))
    distance = (target - position).norm()
    assert torch.allclose(
        ahead, torch.stack([torch.zeros_like(distance), torch.zeros_like(distance), distance])
    )
    assert above[1] < 0  # y points down
    assert abs(above[0]) < 1e-12
    assert torch.allclose(torch.linalg.det(pose[:, :3]), torch.ones((), dtype=F64))


def test_look_at_along_up_and_onto_itself():
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    pose = look_at(5 * up, 0 * up, up)
    assert torch.allclose(pose[:, :3] @ pose[:, :3].T, torch.eye(3, dtype=F64))
    with pytest.raises(ValueError, match="same point"):
        look_at(up, up, up)
