"""The densification statistics: a closed form, the reference, threads, wrong input."""

import math

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Splats2D, reference

from .scenes import Variant, assert_close


def splats_of(
    ids: Tensor, packed: Tensor, grad: Tensor, abs_grad: Tensor | None = None
) -> Splats2D:
    packed = packed.clone().requires_grad_()
    packed.grad = grad
    return Splats2D(packed, ids.to(torch.int32), 3, abs_grad)


def test_one_gaussian(variant: Variant) -> None:
    """A gradient of (3, 4) on a 2×2 screen has norm 5; invisible rows stay unchanged."""
    norm_sum = torch.tensor([1.0, 2.0, 3.0], dtype=variant.dtype)
    views = torch.tensor([0.0, 7.0, 0.0], dtype=variant.dtype)
    radii = torch.tensor([1.0, 1.0, 9.0], dtype=variant.dtype)
    packed, grad = torch.zeros(2, 1, 16, dtype=variant.dtype)
    packed[0, 7] = 6.0
    grad[0, :2] = torch.tensor([3.0, 4.0])
    splats = splats_of(torch.tensor([1]), packed, grad)
    variant.ops.accumulate_screen_statistics(splats, 2, 2, norm_sum, views, radii)
    assert norm_sum.tolist() == [1.0, 7.0, 3.0]
    assert views.tolist() == [0.0, 8.0, 0.0]
    assert radii.tolist() == [1.0, 6.0, 9.0]


@pytest.mark.parametrize(("absolute", "norm"), [(False, 5.0), (True, 13.0)])
def test_the_absolute_gradient_is_optional(variant: Variant, absolute: bool, norm: float) -> None:
    packed, grad = torch.zeros(2, 1, 16, dtype=variant.dtype)
    grad[0, :2] = torch.tensor([3.0, -4.0])
    abs_grad = torch.tensor([[5.0, 12.0]], dtype=variant.dtype)
    splats = splats_of(torch.tensor([0]), packed, grad, abs_grad)
    norm_sum, views = torch.zeros(2, 1, dtype=variant.dtype)
    variant.ops.accumulate_screen_statistics(splats, 2, 2, norm_sum, views, absolute=absolute)
    assert norm_sum.tolist() == [norm]
    assert views.tolist() == [1.0]


def test_only_a_valid_view_is_added(variant: Variant) -> None:
    ones = torch.ones(1, 16, dtype=variant.dtype)
    splats = splats_of(torch.tensor([0]), ones, ones)
    sums = torch.zeros(3, 1, dtype=variant.dtype)
    for valid, views in ((False, 0.0), (True, 1.0)):
        variant.ops.accumulate_screen_statistics(splats, 2, 2, *sums, valid=torch.tensor([valid]))
        assert sums[1:].tolist() == [[views], [views]]


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("with_radii", [True, False])
def test_native_agrees_with_the_reference(
    native: Variant, with_radii: bool, absolute: bool
) -> None:
    generator = torch.Generator().manual_seed(1)
    ids = torch.randperm(20_000, generator=generator)[:9_000].sort().values
    packed, grad = torch.randn(2, 9_000, 16, generator=generator, dtype=torch.float64)
    abs_grad = torch.rand(9_000, 2, generator=generator, dtype=torch.float64)

    def accumulate(implementation: Variant, dtype: torch.dtype) -> Tensor:
        sums = torch.zeros(3, 20_000, dtype=dtype)
        splats = splats_of(ids, packed.to(dtype), grad.to(dtype), abs_grad.to(dtype))
        radii = sums[2] if with_radii else None
        implementation.accumulate_screen_statistics(
            splats, 640, 360, sums[0], sums[1], radii, absolute=absolute
        )
        return sums

    expected = accumulate(reference, torch.float64)
    for threads in (1, 3):
        ops.set_num_threads(threads)
        found = accumulate(native.ops, native.dtype)
        for row in range(3):
            assert_close(found[row].double(), expected[row], 1e-6)


def test_rows_without_a_gaussian(native: Variant) -> None:
    """Splats with the id -1 are skipped. If `valid` is False, all splats are skipped."""
    packed, grad = torch.ones(2, 3, 16, dtype=native.dtype)
    packed[::2], grad[::2] = math.nan, math.nan
    splats = splats_of(torch.tensor([-1, 2, -1]), packed, grad)
    sums = torch.zeros(3, 4, dtype=native.dtype)
    for valid, views in ((torch.tensor([False]), 0.0), (torch.tensor([True]), 1.0)):
        native.ops.accumulate_screen_statistics(splats, 2, 2, *sums, valid=valid)
        assert sums[1].tolist() == [0.0, 0.0, views, 0.0]
        assert sums[2].tolist() == [0.0, 0.0, views, 0.0]
    assert_close(sums[0], torch.tensor([0.0, 0.0, math.sqrt(2), 0.0]), 1e-6)


def test_wrong_input() -> None:
    splats = splats_of(torch.tensor([0, 1]), torch.zeros(2, 16), torch.zeros(2, 16))
    sums = torch.zeros(5)
    with pytest.raises(ValueError, match="views"):
        ops.accumulate_screen_statistics(splats, 4, 4, sums, sums[:4])
    with pytest.raises(ValueError, match="max_radii"):
        ops.accumulate_screen_statistics(splats, 4, 4, sums, sums.clone(), sums.double())
    with pytest.raises(ValueError, match="gradient"):
        ops.accumulate_screen_statistics(splats, 4, 4, sums, sums.clone(), absolute=True)
    splats.abs_grad = torch.zeros(3, 2)
    with pytest.raises(ValueError, match="gradient"):
        ops.accumulate_screen_statistics(splats, 4, 4, sums, sums.clone(), absolute=True)
    splats.packed.grad = None
    with pytest.raises(ValueError, match="gradient"):
        ops.accumulate_screen_statistics(splats, 4, 4, sums, sums.clone())
