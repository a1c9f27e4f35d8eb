"""Extreme input: for any finite parameters, all results are finite.

The search by hypothesis takes seconds here. With SNOWSPLAT_FUZZ=20000, it draws as many cases of
each check, others in each run (or those of `--hypothesis-seed`), and a fiftieth on the emulation.
"""

import math
import os
from collections.abc import Callable

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from snowsplat.ops import AdamRates, Splats2D

from .extremes import (
    CHECKS,
    COLORS,
    FOCALS,
    OPACITIES,
    PLACES,
    QUATS,
    SCALES,
    SIZES,
    Extreme,
    check_harm,
    check_photometric,
    check_project,
    check_rasterize,
)
from .scenes import (
    PARAMETERS,
    Variant,
    assert_close,
    generator,
    leaf_splats,
    normal,
    random_scene,
    random_splats,
    take_step,
)


def assert_finite(tensors: dict[str, Tensor | None]) -> None:
    for name, tensor in tensors.items():
        assert tensor is not None, name
        assert tensor.isfinite().all(), f"{name} is not finite"


def extreme(shift: int, count: int) -> Extreme:
    """Gaussians that have all extreme values, in other combinations for each ``shift``."""
    values = (PLACES, SCALES, QUATS, OPACITIES, COLORS)
    gaussians = [
        tuple(kinds[(i + shift * k) % len(kinds)] for k, kinds in enumerate(values))
        for i in range(count)
    ]
    size, focal = SIZES[shift % len(SIZES)], FOCALS[shift % len(FOCALS)]
    return Extreme(shift, size, focal, shift % 4, tuple(gaussians))


@pytest.mark.parametrize("shift", range(6))
@pytest.mark.parametrize("check", [check_project, check_rasterize])
def test_all_extreme_values(variant: Variant, check: Callable[..., None], shift: int) -> None:
    """And images of any size. The random cases below are few, in particular of the emulation."""
    check(variant, extreme(shift, len(PLACES)))


@pytest.mark.parametrize("count", [0, 1])
def test_no_gaussian_or_one(variant: Variant, count: int) -> None:
    check_project(variant, extreme(0, count))
    check_rasterize(variant, extreme(0, count))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nonfinite_gaussians_do_not_affect_others(variant: Variant, value: float) -> None:
    """In each parameter; the results of all other Gaussians are bit-identical."""
    for shift in range(3):
        picks = [i % (len(PARAMETERS) + 1) for i in range(len(PLACES))]
        check_harm(variant, extreme(shift, len(PLACES)), value, picks)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nonfinite_splats_are_not_drawn(native: Variant, value: float) -> None:
    """A non-finite mean or conic; the other splats are not affected."""
    splats = random_splats(3, 120, 23, 17)
    broken = splats.packed.clone()
    for i in range(0, 120, 7):
        broken[i, i % 5] = value
    rows = broken.isfinite().all(dim=1)
    images, grads = [], []
    for packed in (broken, splats.packed[rows]):
        leaf = leaf_splats(Splats2D(packed, None, 3), native.dtype)
        image, _, _ = native.ops.rasterize(leaf, 23, 17)
        image.square().sum().backward()
        assert leaf.packed.grad is not None
        images.append(image.detach())
        grads.append(leaf.packed.grad)
    assert_close(images[0], images[1], native.forward)
    assert_close(grads[0][rows], grads[1], native.backward)


MANY = int(os.environ.get("SNOWSPLAT_FUZZ", "0"))
#: Number of cases by engine: the emulation is a hundred times slower.
EXAMPLES = {
    "native": MANY or 25,
    "emulated": max(MANY // 50, 3),
    "cuda": MANY or 25,
    "webgpu": max(MANY // 50, 3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_random_extremes(native: Variant, name: str) -> None:
    """Projection with its gradient and Adam, rasterization with its gradient and the statistics,
    non-finite Gaussians among others, distances, plane sweeps, the loss."""
    strategies, holds = CHECKS[name]

    @settings(
        max_examples=EXAMPLES[native.engine],
        deadline=None,
        derandomize=not MANY,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.tuples(*strategies))
    def check(drawn: tuple) -> None:
        holds(native, *drawn)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(16384, 2), (2, 16384)])
def test_long_images(native: Variant, size: tuple[int, int]) -> None:
    """The loss, and the image at both ends, are correct for 16384×2 and 2×16384 pixels."""
    if native.engine == "emulated":  # which is slow; these are more than 256 tiles
        size = min(size[0], 4200), min(size[1], 4200)
    if native.dtype == torch.float32:
        check_photometric(native, (1, size, "noise", True), 0.2)
    width, height = size
    splats = random_splats(1, 40, width, height)
    splats.packed[:2, :2] = torch.tensor([[1.0, 1.0], [width - 1.0, height - 1.0]])
    leaf = leaf_splats(splats, native.dtype)
    image, alpha, depth = native.ops.rasterize(leaf, width, height, with_depth=True)
    assert depth is not None
    (image.sum() + alpha.sum() + depth.sum()).backward()
    assert_finite({"image": image, "alpha": alpha, "depth": depth, "gradient": leaf.packed.grad})
    assert alpha[0, 0] > 0
    assert alpha[-1, -1] > 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("visible_only", [False, True])
def test_gradients_that_overflow_are_skipped(
    variant: Variant, value: float, visible_only: bool
) -> None:
    """Rows with such numbers are counted and stay unchanged; all others are updated."""
    scene = random_scene(6, 130)
    ids = scene.to(variant.dtype, requires_grad=False).project(variant.ops).ids
    assert ids is not None
    grad = normal(generator(2), len(ids), 16)
    extra = torch.zeros(130, dtype=variant.dtype)
    breaks = value if variant.dtype == torch.float32 or value != 1e30 else 1e300
    grad[3, 5], grad[8, 9] = breaks, breaks  # gradients of an opacity and of a colour
    extra[int(ids[20])] = breaks
    results = []
    for packed_grad in (grad, torch.where(grad.abs() < 1e9, grad, 0.0)):
        state = scene.to(variant.dtype, requires_grad=False)
        m, v = ({n: torch.zeros_like(p) for n, p in state.params.items()} for _ in range(2))
        nonfinite_rows = torch.ones(6, dtype=torch.int32)
        broken = packed_grad is grad
        state.params["opacity_logits"].grad = extra if broken else torch.zeros_like(extra)
        take_step(
            variant.ops,
            state,
            m,
            v,
            ids,
            packed_grad.to(variant.dtype),
            AdamRates(dict.fromkeys(m, 1e-3), 1),
            visible_only=visible_only,
            nonfinite_rows=nonfinite_rows,
        )
        for tensors in (state.params, m, v):
            assert_finite(dict(tensors))
        results.append((state.params, m, v))
        # A colour depends on the direction, so its gradient also affects the mean.
        assert nonfinite_rows.tolist() == ([2, 1, 1, 3, 2, 2] if broken else [1] * 6)
    rows = ids[torch.tensor([3, 8, 20])].long()
    others = torch.ones(130, dtype=torch.bool)
    others[rows] = False
    for broken, clean in zip(*results, strict=True):
        for name in PARAMETERS:
            assert torch.equal(broken[name][others], clean[name][others]), name
    logits = results[0][0]["opacity_logits"][rows[[0, 2]]]
    assert torch.equal(logits, scene.params["opacity_logits"].to(variant.dtype)[rows[[0, 2]]])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_statistics_skip_nonfinite_gradients(variant: Variant, value: float) -> None:
    splats = random_splats(2, 4, 23, 17)
    packed = splats.packed.to(variant.dtype).requires_grad_()
    packed.grad = torch.ones_like(packed)
    packed.grad[1, 0] = value
    seen = Splats2D(packed, torch.arange(4, dtype=torch.int32), 3)
    sums = torch.zeros(3, 4, dtype=variant.dtype)
    variant.ops.accumulate_screen_statistics(seen, 2, 2, *sums)
    assert sums.isfinite().all()
    assert sums[1].tolist() == [1.0, 0.0, 1.0, 1.0]
