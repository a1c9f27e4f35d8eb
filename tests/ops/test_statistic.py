"""The densification statistic: a closed form, the twin, any number of threads, wrong input."""

from __future__ import annotations

import pytest
import torch

from snowsplat import ops
from snowsplat.ops import reference

from .scenes import Variant, assert_close

pytestmark = pytest.mark.isa


def test_one_gaussian(variant: Variant) -> None:
    """A gradient of (3, 4) on a 2×2 screen has norm 5; rows that are not seen stay as they are."""
    norm_sum = torch.tensor([1.0, 2.0, 3.0], dtype=variant.dtype)
    views = torch.tensor([0.0, 7.0, 0.0], dtype=variant.dtype)
    grad = torch.zeros(1, 16, dtype=variant.dtype)
    grad[0, :2] = torch.tensor([3.0, 4.0])
    ids = torch.tensor([1], dtype=torch.int32)
    variant.ops.accumulate_screen_gradients(ids, grad, 2, 2, norm_sum, views)
    assert norm_sum.tolist() == [1.0, 7.0, 3.0]
    assert views.tolist() == [0.0, 8.0, 0.0]


def test_native_is_the_twin(native: Variant) -> None:
    generator = torch.Generator().manual_seed(1)
    ids = torch.randperm(20_000, generator=generator)[:9_000].sort().values.to(torch.int32)
    grad = torch.randn(9_000, 16, generator=generator, dtype=torch.float64)
    expected = torch.zeros(20_000, dtype=torch.float64), torch.zeros(20_000, dtype=torch.float64)
    reference.accumulate_screen_gradients(ids, grad, 640, 360, *expected)
    for threads in (1, 3):
        ops.set_num_threads(threads)
        found = torch.zeros(20_000, dtype=native.dtype), torch.zeros(20_000, dtype=native.dtype)
        native.ops.accumulate_screen_gradients(ids, grad.to(native.dtype), 640, 360, *found)
        assert_close(found[0], expected[0], 1e-6)
        assert torch.equal(found[1].double(), expected[1])


def test_wrong_input() -> None:
    ids, grad, sums = torch.zeros(2, dtype=torch.int32), torch.zeros(2, 16), torch.zeros(5)
    with pytest.raises(ValueError, match="packed_grad"):
        ops.accumulate_screen_gradients(ids, grad[:1], 4, 4, sums, sums.clone())
    with pytest.raises(ValueError, match="views"):
        ops.accumulate_screen_gradients(ids, grad, 4, 4, sums, sums[:4])
    with pytest.raises(ValueError, match="ids"):
        ops.accumulate_screen_gradients(ids.long(), grad, 4, 4, sums, sums.clone())
