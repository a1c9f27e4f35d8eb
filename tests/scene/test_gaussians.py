"""`Gaussians`: activations, selecting and joining rows, initialisation."""

import math
from dataclasses import dataclass

import pytest
import torch

from snowsplat.scene.gaussians import SH_C0, Gaussians


def zeros(n: int, rest: int = 15, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, rest, 3)]
    return [torch.zeros(shape, dtype=dtype) for shape in shapes]


@dataclass
class Points:
    xyz: torch.Tensor
    rgb: torch.Tensor


def test_activations():
    g = Gaussians(*zeros(2))
    g.log_scales[0] = torch.tensor([0.0, math.log(2.0), -1.0])
    g.quats[:] = torch.tensor([[3.0, 0.0, 4.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    g.opacity_logits[0] = math.log(3.0)
    g.sh_dc[0, 0] = torch.tensor([0.5, 0.0, -0.5]) / SH_C0
    torch.testing.assert_close(g.scales[0], torch.tensor([1.0, 2.0, math.exp(-1.0)]))
    torch.testing.assert_close(g.rotations[0], torch.tensor([0.6, 0.0, 0.8, 0.0]))
    assert g.rotations[1].isfinite().all()  # also for a zero quaternion
    torch.testing.assert_close(g.opacities, torch.tensor([0.75, 0.5]))
    torch.testing.assert_close(g.base_colors[0], torch.tensor([1.0, 0.5, 0.0]))


@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_sh_degree(rest, degree):
    assert Gaussians(*zeros(4, rest)).sh_degree == degree


@pytest.mark.parametrize("position", range(6))
def test_shapes_and_dtypes_that_do_not_match(position):
    for wrong in (torch.zeros(3, 2), torch.zeros(4, 3), torch.zeros(5, 7, 3), torch.zeros(())):
        tensors = zeros(5)
        tensors[position] = wrong
        with pytest.raises(ValueError, match=r"shape|coefficients"):
            Gaussians(*tensors)
    tensors = zeros(5)
    tensors[position] = tensors[position].long()
    with pytest.raises(ValueError, match="int64"):
        Gaussians(*tensors)
    tensors[position] = zeros(5)[position].double()
    with pytest.raises(ValueError, match="float64"):
        Gaussians(*tensors)


def test_select_append_cat():
    g = Gaussians(*(torch.randn_like(t) for t in zeros(6, 3)))
    picked = g.select(torch.tensor([4, 0, 4]))
    for name, tensor in g.parameters().items():
        assert torch.equal(picked.parameters()[name], tensor[[4, 0, 4]])
    mask = torch.tensor([True, False, True, True, False, False])
    both = g.select(mask).append(g.select(~mask))
    assert len(both) == 6
    for name, tensor in g.parameters().items():
        assert torch.equal(both.parameters()[name], tensor[[0, 2, 3, 1, 4, 5]])
        assert both.parameters()[name].is_contiguous()
    with pytest.raises(RuntimeError):
        Gaussians.cat([g, Gaussians(*zeros(2, 8))])
    double = g.to(dtype=torch.float64)
    assert double.sh_rest.dtype == torch.float64
    g.means.requires_grad_()
    assert not g.detach().means.requires_grad
    assert g.detach().means.data_ptr() == g.means.data_ptr() != g.clone().means.data_ptr()


def test_from_points_uses_colour_and_spacing():
    # The corners of a unit square. Each has two neighbours at distance 1 and one at sqrt(2).
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    rgb = torch.tensor([[0, 128, 255]] * 4, dtype=torch.uint8)
    g = Gaussians.from_points(Points(xyz, rgb), sh_degree=2, initial_opacity=0.1)
    expected = torch.full((4, 3), (2 + math.sqrt(2)) / 3)
    torch.testing.assert_close(g.scales, expected)
    torch.testing.assert_close(g.base_colors, rgb / 255.0)
    torch.testing.assert_close(g.opacities, torch.full((4,), 0.1))
    assert torch.equal(g.means, xyz)
    assert g.means.data_ptr() != xyz.data_ptr()
    assert g.sh_degree == 2
    assert g.sh_rest.count_nonzero() == 0
    assert torch.equal(g.quats, torch.tensor([[1.0, 0, 0, 0]] * 4))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_fewer_points_than_neighbours(n):
    points = Points(torch.randn(n, 3), torch.zeros(n, 3, dtype=torch.uint8))
    g = Gaussians.from_points(points)
    assert len(g) == n
    assert g.log_scales.isfinite().all()


def test_coincident_points_have_a_size_and_no_points_is_an_error():
    xyz = torch.cat([torch.zeros(5, 3), torch.rand(20, 3)])
    g = Gaussians.from_points(Points(xyz, torch.zeros(25, 3, dtype=torch.uint8)))
    assert g.log_scales.isfinite().all()
    same = Gaussians.from_points(Points(torch.ones(9, 3), torch.zeros(9, 3, dtype=torch.uint8)))
    assert same.log_scales.isfinite().all()
    with pytest.raises(ValueError, match="at least one point"):
        Gaussians.from_points(Points(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)))


def test_usable_rows():
    gaussians = Gaussians(
        torch.zeros(4, 3),
        torch.zeros(4, 3),
        torch.zeros(4, 4),
        torch.zeros(4),
        torch.zeros(4, 1, 3),
        torch.zeros(4, 0, 3),
    )
    gaussians.quats[1, 3] = torch.nan
    gaussians.log_scales[2, 0] = torch.inf
    gaussians.opacity_logits[3], gaussians.opacity_logits[0] = torch.inf, -torch.inf
    gaussians.log_scales[3, 1] = -torch.inf
    assert gaussians.usable_rows().tolist() == [True, False, False, True]
    assert gaussians.select(torch.arange(0)).usable_rows().tolist() == []


def test_select_in_place_is_select():
    g = Gaussians(*(torch.randn_like(t) for t in zeros(6, 3)))
    index = torch.tensor([4, 0, 4])
    picked = g.select(index)
    g.select_(index)
    for name, tensor in picked.parameters().items():
        assert torch.equal(g.parameters()[name], tensor)
