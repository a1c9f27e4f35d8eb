"""`add_project_gradients`: the backward pass of `project`, summed over views."""

import functools
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import AdamRates, SplatGradient, reference

from .scenes import (
    PARAMETERS,
    Scene,
    Variant,
    assert_close,
    generator,
    normal,
    one_line,
    random_scene,
    take_step,
)

CASES = [(0, 0), (0, 15), (1, 3), (1, 15), (2, 8), (3, 15)]


def packed_grads(seed: int, count: int) -> Tensor:
    """A cotangent (M, 16), nonzero in every column: radii and padding must be ignored."""
    return normal(generator(seed), count, 16)


def visible(variant: Variant, scene: Scene) -> Tensor:
    ids = scene.project(variant.ops).ids
    assert ids is not None
    return ids


def add(variant: Variant, scene: Scene, grads: dict[str, Tensor], seed: int) -> None:
    """Add the gradient of one view."""
    ids = visible(variant, scene)
    grad = packed_grads(seed, len(ids)).to(variant.dtype)
    gradient = SplatGradient(ids, grad)
    variant.ops.add_project_gradients(scene.gaussians, grads, gradient, scene.view)


def added(variant: Variant, scene: Scene, *seeds: int) -> dict[str, Tensor]:
    """The sum over views of the same camera, one for each seed."""
    scene = scene.to(variant.dtype, requires_grad=False)
    grads = {name: torch.zeros_like(p) for name, p in scene.params.items()}
    for seed in seeds:
        add(variant, scene, grads, seed)
    return grads


@functools.cache
def by_autograd(count: int, degree: int = 3, rest: int = 15) -> dict[str, Tensor]:
    """In float64, through the reference's `project`."""
    leaf = scene_of(count, degree, rest).to(torch.float64)
    splats = leaf.project(reference)
    if len(splats):
        splats.packed.backward(packed_grads(1, len(splats)))
    return {n: torch.zeros_like(p) if p.grad is None else p.grad for n, p in leaf.params.items()}


def test_of_antialiased_splats(variant: Variant) -> None:
    scene = random_scene(5, 60, pixels=0.5).antialiased()
    leaf = scene.to(torch.float64)
    splats = leaf.project(reference)
    splats.packed.backward(packed_grads(1, len(splats)))
    scene = scene.to(variant.dtype, requires_grad=False)
    grads = {name: torch.zeros_like(p) for name, p in scene.params.items()}
    add(variant, scene, grads, 1)
    for name, p in leaf.params.items():
        assert p.grad is not None
        assert_close(grads[name], p.grad, variant.backward, name)


def scene_of(count: int, degree: int = 3, rest: int = 15) -> Scene:
    return random_scene(70 + count, count, sh_degree=degree, rest=rest)


@pytest.mark.parametrize(("degree", "rest"), CASES)
def test_the_gradient_of_one_view(variant: Variant, degree: int, rest: int) -> None:
    """That of autograd, which the tests of `project` check by finite differences."""
    got = added(variant, scene_of(61, degree, rest), 1)
    for name, wanted in by_autograd(61, degree, rest).items():
        assert_close(got[name], wanted, variant.backward, name)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 17, 63, 64, 65, 300])
def test_any_count(native: Variant, count: int) -> None:
    got = added(native, scene_of(count), 1)
    for name, wanted in by_autograd(count).items():
        assert_close(got[name], wanted, native.backward, name)


def test_views_are_summed(variant: Variant) -> None:
    """In the order of the calls, to the last bit; the rows of invisible Gaussians keep theirs."""
    scene = scene_of(40)
    hidden = torch.ones(40, dtype=torch.bool)
    hidden[visible(variant, scene.to(variant.dtype, requires_grad=False)).long()] = False
    assert 0 < hidden.sum() < 40
    first, second, both = (added(variant, scene, *seeds) for seeds in ((1,), (2,), (1, 2)))
    for name in PARAMETERS:
        assert torch.equal(both[name], first[name] + second[name]), name
        assert not both[name][hidden].any(), name
        assert both[name][~hidden].any(), name


def test_rows_beyond_the_degree_get_no_gradient(variant: Variant) -> None:
    scene = scene_of(25, degree=1).to(variant.dtype, requires_grad=False)
    grads = {name: torch.full_like(p, 7.0) for name, p in scene.params.items()}
    add(variant, scene, grads, 1)
    assert torch.equal(grads["sh_rest"][:, 3:], torch.full_like(grads["sh_rest"][:, 3:], 7.0))
    assert not torch.equal(grads["sh_rest"][:, :3], torch.full_like(grads["sh_rest"][:, :3], 7.0))


def test_rows_without_a_gaussian(native: Variant) -> None:
    """On a GPU, splats of the id -1 are skipped; on the CPU, they are an error."""
    scene = scene_of(130).to(native.dtype, requires_grad=False)
    ids = visible(native, scene)
    every_id = torch.full((130,), -1, dtype=torch.int32)
    every_id[ids.long()] = ids
    every_grad = torch.full((130, 16), math.nan, dtype=native.dtype)
    every_grad[ids.long()] = packed_grads(1, len(ids)).to(native.dtype)
    grads = {name: torch.zeros_like(p) for name, p in scene.params.items()}
    arguments = (scene.gaussians, grads, SplatGradient(every_id, every_grad), scene.view)
    if native.engine == "native":
        with pytest.raises(ValueError, match="add_project_gradients") as caught:
            native.ops.add_project_gradients(*arguments)
        assert one_line(caught.value)
        assert not any(grad.any() for grad in grads.values())
        return
    native.ops.add_project_gradients(*arguments)
    for name, wanted in added(native, scene_of(130), 1).items():
        assert torch.equal(grads[name], wanted), name


@pytest.mark.parametrize("visible_only", [False, True])
def test_a_step_with_the_sum_is_a_step_with_the_gradient(
    variant: Variant, visible_only: bool
) -> None:
    """One view: `adam_step` computes the gradient, or takes it from `.grad`."""
    results = []
    for fused in (True, False):
        scene = scene_of(60).to(variant.dtype, requires_grad=False)
        params = scene.params
        ids = visible(variant, scene)
        grad: Tensor | None = packed_grads(1, len(ids)).to(variant.dtype)
        if not fused:
            for name, total in added(variant, scene_of(60), 1).items():
                params[name].grad = total
            grad = None
        moments = [{n: torch.full_like(p, 0.1) for n, p in params.items()} for _ in range(2)]
        rates = AdamRates(dict.fromkeys(PARAMETERS, 0.01), 3)
        take_step(variant.ops, scene, *moments, ids, grad, rates, visible_only=visible_only)
        groups = zip(("", "m of ", "v of "), (params, *moments), strict=True)
        results.append({prefix + n: t for prefix, group in groups for n, t in group.items()})
    for name, wanted in results[0].items():
        assert_close(results[1][name], wanted, variant.forward, name)


WRONG = {
    "ids without their gradient": {"packed_grad": torch.zeros(3, 16)},
    "ids of another type": {"ids": torch.arange(2)},
    "gradient of another width": {"packed_grad": torch.zeros(2, 32)},
    "gradient of another dtype": {"packed_grad": torch.zeros(2, 16).double()},
    "no gradient": {"packed_grad": None},
    "degree beyond the rows": {"params": {"sh_rest": torch.zeros(4, 8, 3)}},
    "sum of another shape": {"grads": {"means": torch.zeros(4, 4)}},
    "sum of another dtype": {"grads": {"means": torch.zeros(4, 3).double()}},
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict[str, Any]) -> None:
    scene = random_scene(1, 4).to(torch.float32, requires_grad=False)
    grads = {n: torch.zeros_like(p) for n, p in scene.params.items()}
    gaussians = SimpleNamespace(**scene.params | change.get("params", {}))
    ids = change.get("ids", torch.arange(2, dtype=torch.int32))
    gradient = SplatGradient(ids, change.get("packed_grad", torch.zeros(2, 16)))
    grads |= change.get("grads", {})
    with pytest.raises(ValueError, match="^add_project_gradients: ") as caught:
        ops.add_project_gradients(gaussians, grads, gradient, scene.view)
    assert one_line(caught.value)
    assert not any(grad.any() for grad in grads.values())
