import itertools

import torch

from snowsplat.density.rows import BITS, finite_rows, morton_order
from snowsplat.gaussians import Gaussians


def interleaved(cell: tuple[int, int, int]) -> int:
    """The Morton code by its definition, one bit at a time."""
    return sum(
        ((cell[axis] >> bit) & 1) << (3 * bit + axis) for bit in range(BITS) for axis in (0, 1, 2)
    )


def test_morton_order_is_that_of_the_interleaved_bits():
    side = 2**BITS - 1
    cells = list(itertools.product((0, 1, 5, 2**20, side), repeat=3))
    order = morton_order(torch.tensor(cells, dtype=torch.float64))
    assert [cells[i] for i in order] == sorted(cells, key=interleaved)


def test_morton_order_keeps_neighbours_together_beside_a_stray_point():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(4000, 3, generator=generator)
    points[17] = torch.tensor([1000.0, -1000.0, 500.0])
    order = morton_order(points)
    assert torch.equal(order.sort().values, torch.arange(4000))
    ordered = points[order]
    steps = (ordered[1:] - ordered[:-1]).norm(dim=1).median()
    shuffled = (points[1:] - points[:-1]).norm(dim=1).median()
    assert steps < 0.2 * shuffled


def test_morton_order_of_equal_points_and_of_none():
    assert torch.equal(morton_order(torch.ones(5, 3)), torch.arange(5))
    assert len(morton_order(torch.empty(0, 3))) == 0


def test_finite_rows():
    gaussians = Gaussians(
        torch.zeros(4, 3),
        torch.zeros(4, 3),
        torch.zeros(4, 4),
        torch.zeros(4),
        torch.zeros(4, 1, 3),
        torch.zeros(4, 0, 3),
    )
    gaussians.quats[1, 3] = torch.nan
    gaussians.opacity_logits[2] = torch.inf
    assert finite_rows(gaussians).tolist() == [True, False, False, True]
