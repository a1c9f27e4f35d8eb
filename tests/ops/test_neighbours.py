"""`neighbours`: known distances, and native against the reference."""

import functools
import math

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference

from .scenes import Variant, as_float32, assert_close, generator, normal, one_line, uniform


def grid(*counts: int, spacing: float = 1.0) -> Tensor:
    axes = [torch.arange(n, dtype=torch.float64) * spacing for n in counts]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(counts))


def test_grid(variant: Variant) -> None:
    """Every point of a grid has at least three neighbours at the grid spacing."""
    points = grid(7, 5, 4, spacing=0.25).to(variant.dtype)
    distances = variant.ops.neighbours(points, k=4)
    assert distances.dtype == variant.dtype
    assert (distances[:, :3] == 0.25).all()
    corner = torch.tensor([0.25, 0.25, 0.25, 0.25 * math.sqrt(2)])
    assert_close(distances[0], corner, 1e-6)


def test_line(variant: Variant) -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]]).to(variant.dtype)
    expected = torch.tensor([[1.0, 3, 7], [1, 2, 6], [2, 3, 4], [4, 6, 7]])
    assert torch.equal(variant.ops.neighbours(points).float(), expected)
    assert torch.equal(variant.ops.neighbours(points, k=1).float(), expected[:, :1])


@pytest.mark.parametrize("k", [1, 2, 3, 4, 8, 9, 64])
def test_all_at_the_same_place(variant: Variant, k: int) -> None:
    points = torch.tensor([[-7.0, 0.1, 1e3]]).repeat(70, 1).to(variant.dtype)
    assert (variant.ops.neighbours(points, k) == 0).all()


def test_far_apart(variant: Variant) -> None:
    """Distances near the overflow of squares in float32; the bounding box exceeds it."""
    points = torch.tensor([[-3e18, 0, 0], [0, 4e18, 0], [0, 0, 0]]).to(variant.dtype)
    expected = torch.tensor([[3e18, 5e18], [4e18, 5e18], [3e18, 4e18]])
    assert_close(variant.ops.neighbours(points, k=2) / 1e18, expected / 1e18, 1e-6)
    corner = torch.full((1, 3), 3e38).to(variant.dtype)
    distances = variant.ops.neighbours(torch.cat([points, -corner, corner]), k=2)
    assert_close(distances[:3] / 1e18, expected / 1e18, 1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_fewer_points_than_neighbours(variant: Variant, count: int) -> None:
    """Missing neighbours are at an infinite distance."""
    distances = variant.ops.neighbours(grid(count, 1, 1).to(variant.dtype), k=3)
    assert distances.shape == (count, 3)
    assert distances.isfinite().sum(dim=1).tolist() == [count - 1] * count


# A group of a GPU, and a task of the CPU, has 1024 points.
CLOUDS = {
    "4 points": lambda g: normal(g, 4, 3),
    "17 points": lambda g: normal(g, 17, 3),
    "Gaussian": lambda g: normal(g, 1100, 3),
    "many": lambda g: normal(g, 2100, 3),
    "uniform": lambda g: uniform(g, 0, 1, 1100, 3),
    "plane": lambda g: normal(g, 600, 3) * torch.tensor([1.0, 0, 1]),
    "line": lambda g: normal(g, 500, 1) * torch.tensor([1.0, 2, -3]),
    "clusters": lambda g: 100 * normal(g, 8, 3).repeat(60, 1) + 0.01 * normal(g, 480, 3),
    "heavy tails": lambda g: normal(g, 600, 3) * torch.exp(3 * normal(g, 600, 1)),
    "duplicates": lambda g: normal(g, 60, 3).repeat(10, 1),
    "far from the origin": lambda g: 64 + uniform(g, 0, 1, 400, 3),
    "one outlier": lambda g: torch.cat([uniform(g, 0, 1, 400, 3), torch.tensor([[1e6, 0, 0]])]),
    "one far outlier": lambda g: torch.cat([normal(g, 300, 3), torch.tensor([[0, -1e14, 0.0]])]),
}


@functools.cache
def cloud_and_distances(name: str) -> tuple[Tensor, Tensor]:
    """A cloud and the distances to at most 20 neighbours, computed once for all variants."""
    points = as_float32(CLOUDS[name](generator(0)).double())
    return points, reference.neighbours(points, min(20, len(points) - 1))


@pytest.mark.parametrize("k", [1, 3, 20])
@pytest.mark.parametrize("cloud", CLOUDS)
def test_native_agrees_with_the_reference(native: Variant, cloud: str, k: int) -> None:
    points, distances = cloud_and_distances(cloud)
    k = min(k, len(points) - 1)
    actual = native.ops.neighbours(points.to(native.dtype), k)
    # Each distance separately: in the L2 norm over all, the outlier would hide the others.
    torch.testing.assert_close(
        actual.double(), distances[:, :k], rtol=native.forward * 1e-1, atol=1e-12
    )


@pytest.mark.parametrize(
    ("count", "k"),
    [
        *((count, 3) for count in (31, 32, 33, 127, 129, 1023, 1024, 1025)),
        *((200, k) for k in (2, 4, 8, 9, 64)),
    ],
)
def test_native_agrees_with_the_reference_for_any_number(
    native: Variant, count: int, k: int
) -> None:
    points = uniform(generator(count), -1, 1, count, 3)
    expected = reference.neighbours(points, k)
    actual = native.ops.neighbours(points.to(native.dtype), k)
    torch.testing.assert_close(actual.double(), expected, rtol=native.forward * 1e-1, atol=1e-12)


def test_many_points(native: Variant) -> None:
    """More than 32 groups of 32 chunks of 32 points."""
    points = grid(33, 33, 33)
    shuffled = points[torch.randperm(len(points), generator=generator(4))]
    distances = native.ops.neighbours(shuffled.to(native.dtype))
    assert (distances == 1).all()


WRONG = {
    "two columns": (torch.zeros(5, 2), 3),
    "one point": (torch.zeros(3), 3),
    "no neighbours": (torch.zeros(5, 3), 0),
    "integers": (torch.zeros(5, 3, dtype=torch.int32), 3),
    "half": (torch.zeros(5, 3, dtype=torch.float16), 3),
    "NaN": (torch.full((5, 3), math.nan), 3),
    "infinity": (torch.full((5, 3), math.inf), 3),
}


@pytest.mark.parametrize(("points", "k"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input(points: Tensor, k: int) -> None:
    with pytest.raises(ValueError, match="neighbours") as caught:
        ops.neighbours(points, k)
    assert one_line(caught.value)
