"""`points_in_frusta`, `points_in_spheres`: known positions, and native against the reference."""

import math

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Frusta, reference

from .scenes import Variant, as_float32, generator, normal, one_line, uniform


def looking_ahead(dtype: torch.dtype, far: float = math.inf) -> Frusta:
    """One camera at the origin, 4×2 pixels, focal length 2: x / z and 2 y / z are in ±1."""
    to_image = torch.tensor([[[2.0, 0, 2, 0], [0, 2, 1, 0], [0, 0, 1, 0]]], dtype=dtype)
    rows = torch.tensor([[4.0, 2.0], [0.5, far]], dtype=dtype)
    return Frusta(to_image, rows[:1], rows[1:], torch.tensor([2.0], dtype=dtype))


def some_frusta(count: int, dtype: torch.dtype) -> Frusta:
    """Cameras at random places with random directions."""
    random = generator(count)
    rotations = torch.linalg.qr(normal(random, count, 3, 3)).Q
    poses = torch.cat([rotations, normal(random, count, 3, 1)], 2)
    intrinsics = torch.tensor([[50.0, 0, 40], [0, 55, 30], [0, 0, 1]], dtype=poses.dtype)
    size = torch.tensor([[80.0, 60.0]]).expand(count, 2)
    depths = torch.cat([uniform(random, 0.0, 0.5, count, 1), uniform(random, 2, 9, count, 1)], 1)
    rows = intrinsics @ poses, size, depths, torch.full((count,), 55.0)
    return Frusta(*(each.to(dtype) for each in rows))


def test_one_camera(variant: Variant) -> None:
    inside = [[0, 0, 1], [0.9, 0.4, 1], [-1, -0.5, 1], [0, 0, 4]]
    outside = [[1.0, 0, 1], [0, 0.5, 1], [-1.1, 0, 1], [0, -0.6, 1], [0, 0, 0.5], [0, 0, -1]]
    points = torch.tensor([*inside, *outside], dtype=variant.dtype)
    counts, rates = variant.ops.points_in_frusta(points, looking_ahead(variant.dtype))
    assert counts.tolist() == [1.0] * 4 + [0.0] * 6
    assert rates.tolist() == [2.0] * 3 + [0.5] + [0.0] * 6
    assert counts.dtype == rates.dtype == variant.dtype


def test_the_range_of_depths_has_no_ends(variant: Variant) -> None:
    points = torch.tensor([[0, 0, 0.5], [0, 0, 2.9], [0, 0, 3]], dtype=variant.dtype)
    counts, _ = variant.ops.points_in_frusta(points, looking_ahead(variant.dtype, far=3.0))
    assert counts.tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_point_that_is_not_finite_is_nowhere(variant: Variant, value: float) -> None:
    points = torch.tensor([[0, 0, 1.0]] * 4, dtype=variant.dtype)
    for axis in range(3):
        points[axis, axis] = value
    counts, rates = variant.ops.points_in_frusta(points, looking_ahead(variant.dtype))
    assert counts.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert rates.tolist() == [0.0, 0.0, 0.0, 2.0]


def test_nothing(variant: Variant) -> None:
    points = torch.ones(2, 3, dtype=variant.dtype)
    for count in (0, 2):
        found = variant.ops.points_in_frusta(points[:count], some_frusta(0, variant.dtype))
        assert [each.tolist() for each in found] == [[0.0] * count] * 2


@pytest.mark.parametrize(("count", "views"), [(1, 1), (17, 3), (1025, 5), (2100, 40)])
def test_native_agrees_with_the_reference(native: Variant, count: int, views: int) -> None:
    points = 2 * normal(generator(views), count, 3).double()
    frusta = some_frusta(views, torch.float64)
    expected = reference.points_in_frusta(points, frusta)

    def found(threads: int) -> tuple[Tensor, Tensor]:
        ops.set_num_threads(threads)
        rows = (some_frusta(views, native.dtype), points.to(native.dtype))
        return native.ops.points_in_frusta(rows[1], rows[0])

    counts, rates = found(1)
    same = counts.double() == expected[0]  # rounding can move a point across a border
    assert same.double().mean() > 0.998
    torch.testing.assert_close(rates.double()[same], expected[1][same], rtol=1e-4, atol=0)
    assert all(map(torch.equal, found(3), (counts, rates)))


def test_spheres(variant: Variant) -> None:
    """A point on a sphere is not in it. A point that is not finite is in none."""
    points = torch.tensor(
        [[0, 0, 0], [3, 4, 0], [0, 0, 2], [math.nan, 0, 0], [0, math.inf, 0], [0, 0, -1e30]],
        dtype=variant.dtype,
    )
    spheres = torch.tensor([[0.0, 0, 0, 5], [0, 0, 1, 1.5], [0, 0, 9, 0]], dtype=variant.dtype)
    counts, nearest = variant.ops.points_in_spheres(points, spheres)
    assert counts.tolist() == [2.0, 0.0, 2.0, 0.0, 0.0, 0.0]
    assert nearest[:3].tolist() == [0.0, 5.0, 1.0]
    assert nearest[3].isnan()
    assert nearest[4] == math.inf
    assert nearest[5] >= 1e30
    counts, nearest = variant.ops.points_in_spheres(points, spheres[:0])
    assert not counts.any()
    assert nearest.tolist() == [math.inf] * 6
    assert [len(each) for each in variant.ops.points_in_spheres(points[:0], spheres)] == [0, 0]


@pytest.mark.parametrize(("count", "spheres"), [(1, 1), (17, 3), (1025, 5), (2100, 40)])
def test_spheres_agree_with_the_reference(native: Variant, count: int, spheres: int) -> None:
    """Also far from the origin, where the digits of squared coordinates would not suffice."""
    points = 1000 + normal(generator(spheres), count, 3)
    given = torch.cat([1000 + normal(generator(9), spheres, 3), torch.ones(spheres, 1)], 1)
    points, given = as_float32(points), as_float32(given)
    expected = reference.points_in_spheres(points, given)

    def found(threads: int) -> tuple[Tensor, Tensor]:
        ops.set_num_threads(threads)
        return native.ops.points_in_spheres(points.to(native.dtype), given.to(native.dtype))

    counts, nearest = found(1)
    assert (counts.double() == expected[0]).double().mean() > 0.998
    torch.testing.assert_close(nearest.double(), expected[1], rtol=1e-5, atol=0)
    assert all(map(torch.equal, found(3), (counts, nearest)))


def test_wrong_input() -> None:
    points, frusta = torch.ones(2, 3), looking_ahead(torch.float32)
    wrong = {
        "points": (torch.ones(3), frusta),
        "float32 or float64": (points.half(), frusta),
        "to_image": (points.double(), frusta),
        "size": (points, Frusta(frusta.to_image, points, frusta.depths, frusta.focal)),
    }
    for message, arguments in wrong.items():
        with pytest.raises(ValueError, match=message) as caught:
            ops.points_in_frusta(*arguments)
        assert one_line(caught.value)
    for message, given in (("spheres must be", points), ("spheres must be", points.double())):
        with pytest.raises(ValueError, match=message):
            ops.points_in_spheres(points, given)
