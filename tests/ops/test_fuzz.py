"""Extreme input: for any finite parameters, all results are finite.

The search by hypothesis takes seconds here; tests/nightly/fuzz_ops.py runs it for longer.
"""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from snowsplat.ops import AdamRates, Splats2D

from .extremes import CHECKS, LONG, check_photometric
from .scenes import (
    PARAMETERS,
    Scene,
    Variant,
    as_float32,
    assert_close,
    generator,
    leaf_splats,
    normal,
    random_scene,
    random_splats,
    take_step,
    uniform,
)

COUNT = 64


def wild(seed: int) -> dict[str, Tensor]:
    """Extreme values for each parameter of `random_scene`; the tests choose among them."""
    g = generator(seed)
    scene = random_scene(seed, COUNT)
    means, pose = scene.params["means"], scene.cam_from_world
    position = -pose[:, :3].T @ pose[:, 3]
    forward = pose[2, :3]
    on_axis = position + uniform(g, -3, 3, COUNT, 1) * forward
    at_near = position + 0.2 * forward + 1e-4 * normal(g, COUNT, 3)
    zero_quats = scene.params["quats"].clone()
    zero_quats[::2] = 0
    return {
        "huge_scales": torch.full((COUNT, 3), 27.0),
        "tiny_scales": torch.full((COUNT, 3), -27.0),
        "mixed_scales": uniform(g, -27, 27, COUNT, 3),
        "needles": torch.tensor([-27.0, 3.0, -27.0]).expand(COUNT, 3),
        "discs": torch.tensor([3.0, -27.0, 3.0]).expand(COUNT, 3),
        "long_discs": torch.tensor([12.0, -27.0, 3.0]).expand(COUNT, 3),
        "behind": means - 20 * forward,
        "at_camera": position.expand(COUNT, 3),
        "around_camera": position + 0.3 * normal(g, COUNT, 3),
        "on_axis": on_axis,
        "at_near": at_near,
        "far": position + 1e6 * (means - position),
        "sideways": means + 1e5 * pose[0, :3],
        "everywhere": 10 ** uniform(g, -6, 12, COUNT, 1) * normal(g, COUNT, 3),
        "zero_quats": zero_quats,
        "tiny_quats": scene.params["quats"] * 1e-30,
        "huge_quats": scene.params["quats"] * 1e15,
        "opaque": torch.full((COUNT,), 100.0),
        "transparent": torch.full((COUNT,), -100.0),
        "huge_colors": scene.params["sh_rest"] * 1e6,
        "negative_colors": torch.full((COUNT, 1, 3), -100.0),
    }


NAMES = {
    "means": "behind at_camera around_camera on_axis at_near far sideways everywhere",
    "log_scales": "huge_scales tiny_scales mixed_scales needles discs long_discs",
    "quats": "zero_quats tiny_quats huge_quats",
    "opacity_logits": "opaque transparent",
    "sh_rest": "huge_colors",
    "sh_dc": "negative_colors",
}
SINGLE = [(name, case) for name, cases in NAMES.items() for case in cases.split()]


def check(variant: Variant, scene: Scene) -> None:
    """Projects, rasterizes with depth, and takes a step; all intermediate numbers are checked."""
    leaf = scene.to(variant.dtype)
    splats = leaf.project(variant.ops)
    splats.packed.retain_grad()
    width, height = leaf.size
    background = torch.ones(3, dtype=variant.dtype)
    outputs = variant.ops.rasterize(splats, width, height, background, with_depth=True)
    found = {"packed": splats.packed, "image": outputs[0], "alpha": outputs[1]}
    target = torch.rand(height, width, 3, generator=generator(0)).to(variant.dtype)
    loss = variant.ops.photometric_loss(outputs[0], target) + outputs[1].mean()
    loss.backward()
    assert splats.packed.grad is not None
    found.update({"depth": outputs[2], "loss": loss, "packed gradient": splats.packed.grad})
    found.update({f"gradient of {n}": t.grad for n, t in leaf.leaves().items()})
    assert_finite(found)
    assert outputs[1].min() >= 0
    assert outputs[1].max() <= 1

    assert splats.ids is not None
    assert_finite(step(variant, scene, splats.ids, splats.packed.grad))


def step(
    variant: Variant, scene: Scene, ids: Tensor, packed_grad: Tensor
) -> dict[str, Tensor | None]:
    """A first step of Adam: the parameters after it, and their first moments."""
    stepped = scene.to(variant.dtype, requires_grad=False)
    m = {name: torch.zeros_like(p) for name, p in stepped.params.items()}
    v = {name: torch.zeros_like(p) for name, p in stepped.params.items()}
    rates = AdamRates(dict.fromkeys(m, 1e-3), 1)
    take_step(variant.ops, stepped, m, v, ids, packed_grad, rates)
    return {**stepped.params, **{f"m of {name}": tensor for name, tensor in m.items()}}


def assert_finite(tensors: dict[str, Tensor | None]) -> None:
    for name, tensor in tensors.items():
        assert tensor is not None, name
        assert tensor.isfinite().all(), f"{name} is not finite"


@pytest.mark.parametrize(("name", "case"), SINGLE, ids=[case for _, case in SINGLE])
def test_one_extreme_parameter(variant: Variant, name: str, case: str) -> None:
    scene = random_scene(0, COUNT)
    scene.params[name] = as_float32(wild(0)[case].double())
    check(variant, scene)


@pytest.mark.parametrize("seed", range(12))
def test_extreme_parameters_together(variant: Variant, seed: int) -> None:
    """Every parameter of every Gaussian is taken from a random case."""
    scene, cases = random_scene(seed, COUNT), wild(seed)
    g = generator(1000 + seed)
    for name, listed in NAMES.items():
        for case in listed.split():
            taken = torch.rand(COUNT, generator=g) < 0.15
            scene.params[name][taken] = as_float32(cases[case].double())[taken]
    check(variant, scene)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", PARAMETERS)
def test_nonfinite_gaussians_do_not_affect_others(
    variant: Variant, name: str, value: float
) -> None:
    """Ids stay sorted and in range, and the results of all other Gaussians are bit-identical."""
    clean, broken = random_scene(6, 130), random_scene(6, 130)
    healthy = torch.ones(130, dtype=torch.bool)
    healthy[::5] = False
    for row in (~healthy).nonzero()[:, 0].tolist():
        broken.params[name][row].view(-1)[row % broken.params[name][row].numel()] = value
    found = []
    for scene in (clean, broken):
        leaf = scene.to(variant.dtype)
        splats = leaf.project(variant.ops)
        assert splats.ids is not None
        ids = splats.ids.long()
        assert ids.tolist() == sorted({i for i in ids.tolist() if 0 <= i < 130})
        if math.isnan(value) and not name.startswith("sh"):
            assert scene is clean or healthy[ids].all()
        grad = normal(generator(2), 130, 16).to(variant.dtype)[ids]
        splats.packed.backward(grad)
        state = step(variant, scene, splats.ids, grad)
        state.update({f"gradient of {n}": p.grad for n, p in leaf.params.items()})
        rows = {n: t[healthy] for n, t in state.items() if t is not None}
        found.append({"ids": ids[healthy[ids]], "packed": splats.packed[healthy[ids]], **rows})
    for key, expected in found[0].items():
        assert torch.equal(found[1][key], expected), key


@pytest.mark.parametrize("count", [0, 1])
def test_no_gaussian_or_one(variant: Variant, count: int) -> None:
    check(variant, random_scene(3, count))


def test_no_gaussian_is_visible(variant: Variant) -> None:
    scene = random_scene(4, 20)
    scene.params["opacity_logits"][:] = -20.0
    leaf = scene.to(variant.dtype)
    splats = leaf.project(variant.ops)
    assert len(splats) == 0
    assert splats.ids is not None
    assert splats.ids.shape == (0,)
    check(variant, scene)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (16, 16), (17, 31)])
def test_any_image_size(variant: Variant, size: tuple[int, int]) -> None:
    check(variant, random_scene(5, 30, *size))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_splats_of_any_size(variant: Variant, scale: float) -> None:
    splats = random_splats(0, 50, 23, 17)
    splats.packed[:, 2:5] *= scale
    splats.packed[::7, :2] = 1e7
    leaf = leaf_splats(splats, variant.dtype)
    image, alpha, depth = variant.ops.rasterize(leaf, 23, 17, with_depth=True)
    assert depth is not None
    (image.sum() + alpha.sum() + depth.sum()).backward()
    assert_finite({"image": image, "alpha": alpha, "depth": depth, "gradient": leaf.packed.grad})


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


#: Number of cases by engine: the emulation is a hundred times slower.
EXAMPLES = {"native": 25, "emulated": 3, "cuda": 25}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CHECKS if name != "long images"])
def test_random_extremes(native: Variant, name: str) -> None:
    """Projection with its gradient and Adam, rasterization with its gradient and the statistics,
    non-finite Gaussians among others, distances, plane sweeps, the loss."""
    strategies, holds = CHECKS[name]

    @settings(
        max_examples=EXAMPLES[native.engine],
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.tuples(*strategies))
    def check(drawn: tuple) -> None:
        holds(native, *drawn)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("size", LONG)
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
