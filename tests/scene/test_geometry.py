"""Rotations, rigid transforms, similarities: round trips, half turns, gradients, conventions."""

import itertools
import json
import math

import pytest
import torch

from snowsplat.scene.geometry import (
    MORTON_BITS,
    Similarity,
    compose_rigid,
    invert_rigid,
    look_at,
    morton_order,
    quat_from_rotation,
    rotation_from_quat,
    similarity_from_points,
    transform_points,
)

F64 = torch.float64


def random_quats(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 4, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_quarter_turn_around_z_maps_x_to_y():
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
def test_round_trip_of_rotations_near_0_and_180_degrees(axis, angle):
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
    # Also the gradient of the inverse: for random rotations, and near rotations by 180°.
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


def test_look_at_has_the_target_in_front_and_up_upwards():
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


def test_look_at_along_up_and_at_its_own_position():
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    pose = look_at(5 * up, 0 * up, up)
    assert torch.allclose(pose[:, :3] @ pose[:, :3].T, torch.eye(3, dtype=F64))
    # The spare direction is the axis in which the viewing direction is smallest, here the first.
    along_y = look_at(-5 * up.roll(-1), 0 * up, up.roll(-1))
    assert torch.allclose(along_y[2, :3], up.roll(-1))
    assert torch.allclose(along_y[1, :3], torch.tensor([-1.0, 0, 0], dtype=F64))
    with pytest.raises(ValueError, match="same point"):
        look_at(up, up, up)


def test_look_at_of_several_cameras_is_look_at_of_each():
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    positions = torch.tensor([[3.0, -2, 1], [0, 0, 50], [1, 1, 4], [9, 9, 9]], dtype=F64)
    targets = torch.tensor([[0.5, 0.5, 0], [0, 0, 0], [1, 1, 0], [0, 0, 0]], dtype=F64)
    poses = look_at(positions, targets, up)
    for pose, position, target in zip(poses, positions, targets, strict=True):
        torch.testing.assert_close(pose, look_at(position, target, up))
    with pytest.raises(ValueError, match="same point"):
        look_at(positions, positions[[1, 1, 1, 1]], up)


def random_points(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def similarity() -> Similarity:
    rotation = rotation_from_quat(random_quats(1, 8))[0]
    return Similarity(2.5, rotation, torch.tensor([1.0, -2.0, 3.0], dtype=F64))


def test_similarity_scales_then_rotates_then_translates():
    quarter_about_z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=F64)
    new_from_old = Similarity(2.0, quarter_about_z, torch.tensor([10.0, 0, 0], dtype=F64))
    points = torch.tensor([[1.0, 0, 0], [0, 1, 5]], dtype=F64)
    expected = torch.tensor([[10.0, 2, 0], [8, 0, 10]], dtype=F64)
    assert torch.allclose(new_from_old.apply(points), expected)
    assert new_from_old.apply(points.float()).dtype == torch.float32


def test_similarities_are_in_double_precision():
    single = Similarity(2, torch.eye(3), torch.ones(3))
    assert isinstance(single.scale, float)
    assert single.rotation.dtype == single.translation.dtype == F64
    points = random_points(5).float()
    found = similarity_from_points(points, 2 * points + 1)
    assert found.scale == pytest.approx(2)
    assert torch.allclose(found.translation, torch.ones(3, dtype=F64), atol=1e-5)


def test_similarity_and_its_inverse_cancel():
    points = random_points(20).reshape(2, 10, 3)
    there = similarity()
    assert torch.allclose(there.inverse().apply(there.apply(points)), points, atol=1e-13)
    assert torch.allclose(there.apply(there.inverse().apply(points)), points, atol=1e-13)
    assert torch.equal(Similarity.identity().apply(points), points)


def test_similarity_does_not_change_what_cameras_see():
    poses, points, there = rigid(4), random_points(6, 5), similarity()
    moved = there.apply_to_poses(poses)
    in_camera = transform_points(poses, points)
    assert torch.allclose(transform_points(moved, there.apply(points)), 2.5 * in_camera)
    assert torch.allclose(moved[:, :, :3] @ moved[:, :, :3].mT, torch.eye(3, dtype=F64))
    centres = invert_rigid(poses)[:, :, 3]
    assert torch.allclose(invert_rigid(moved)[:, :, 3], there.apply(centres))


def test_similarity_json_round_trip():
    there = similarity()
    back = Similarity.from_json(json.loads(json.dumps(there.to_json())))
    assert back.scale == there.scale
    assert torch.equal(back.rotation, there.rotation)
    assert torch.equal(back.translation, there.translation)


@pytest.mark.parametrize(
    ("scale", "rotation", "translation", "message"),
    [
        (0.0, torch.eye(3), torch.zeros(3), "scale"),
        (math.nan, torch.eye(3), torch.zeros(3), "scale"),
        (1.0, 2 * torch.eye(3), torch.zeros(3), "not a rotation"),
        (1.0, torch.diag(torch.tensor([1.0, 1, -1])), torch.zeros(3), "not a rotation"),
        (1.0, torch.eye(4), torch.zeros(3), r"\(3, 3\)"),
    ],
)
def test_invalid_similarities_are_rejected(scale, rotation, translation, message):
    with pytest.raises(ValueError, match=message):
        Similarity(scale, rotation, translation)


@pytest.mark.parametrize("flat", [False, True])
def test_similarity_from_exact_pairs(flat):
    source, there = random_points(12), similarity()
    if flat:  # all points in a plane: one singular value is 0
        source[:, 2] = 0
    found = similarity_from_points(source, there.apply(source))
    assert found.scale == pytest.approx(there.scale)
    assert torch.allclose(found.rotation, there.rotation)
    assert torch.allclose(found.translation, there.translation)


def test_similarity_of_noisy_pairs_minimises_the_error():
    source = random_points(30)
    target = similarity().apply(source) + 0.1 * random_points(30, 1)

    def loss(s: Similarity) -> float:
        return float((s.apply(source) - target).square().sum())

    found = similarity_from_points(source, target)
    for seed in range(20):
        nudge = torch.cat([torch.ones(1, dtype=F64), 1e-3 * random_points(1, seed)[0]])
        other = Similarity(
            found.scale * (1 + 1e-3 * (seed % 3 - 1)),
            rotation_from_quat(nudge) @ found.rotation,
            found.translation + 1e-3 * random_points(1, seed + 50)[0],
        )
        assert loss(other) > loss(found)


def test_similarity_is_never_a_reflection():
    source = random_points(10)
    found = similarity_from_points(source, source * torch.tensor([1.0, 1, -1], dtype=F64))
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1)


def test_underdetermined_similarities_are_rejected():
    points = random_points(5)
    with pytest.raises(ValueError, match="three"):
        similarity_from_points(points[:2], points[:2])
    line = torch.arange(5, dtype=F64)[:, None] * points[0] + points[1]
    for source, target in ((line, points), (points, line), (points, torch.ones(5, 3))):
        with pytest.raises(ValueError, match="line"):
            similarity_from_points(source, target)
    with pytest.raises(ValueError, match="finite"):
        similarity_from_points(points, points / 0)
    with pytest.raises(ValueError, match="N, 3"):
        similarity_from_points(points, points[:4])


def interleaved(cell: tuple[int, int, int]) -> int:
    """The Morton code from its definition, one bit at a time."""
    return sum(
        ((cell[axis] >> bit) & 1) << (3 * bit + axis)
        for bit in range(MORTON_BITS)
        for axis in (0, 1, 2)
    )


def test_morton_order_sorts_by_interleaved_bits():
    side = 2**MORTON_BITS - 1
    cells = list(itertools.product((0, 1, 5, 2**20, side), repeat=3))
    order = morton_order(torch.tensor(cells, dtype=torch.float64))
    assert [cells[i] for i in order] == sorted(cells, key=interleaved)


def test_morton_order_keeps_neighbours_together_despite_an_outlier():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(4000, 3, generator=generator)
    points[17] = torch.tensor([1000.0, -1000.0, 500.0])
    order = morton_order(points)
    assert torch.equal(order.sort().values, torch.arange(4000))
    ordered = points[order]
    steps = (ordered[1:] - ordered[:-1]).norm(dim=1).median()
    shuffled = (points[1:] - points[:-1]).norm(dim=1).median()
    assert steps < 0.2 * shuffled


def test_morton_order_of_equal_points_and_of_no_points():
    assert torch.equal(morton_order(torch.ones(5, 3)), torch.arange(5))
    none = morton_order(torch.empty(0, 3))
    assert (none.shape, none.dtype) == ((0,), torch.int64)
