"""`adam_step`: known properties of Adam, and native against the reference."""

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import AdamRates, reference

from .scenes import (
    PARAMETERS,
    REFERENCE,
    Adam,
    Scene,
    Variant,
    assert_close,
    generator,
    normal,
    one_line,
    random_scene,
    take_step,
    uniform,
)

RATES = {
    "means": 0.1,
    "log_scales": 5e-3,
    "quats": 1e-2,
    "opacity_logits": 0.05,
    "sh_dc": 2e-2,
    "sh_rest": 1e-2,
}


class Optimised:
    """A scene with moments, and one training step with the ops of a variant."""

    def __init__(self, variant: Variant, scene: Scene, *, fresh: bool = False) -> None:
        self.variant = variant
        self.scene = scene.to(variant.dtype, requires_grad=False)
        self.params = self.scene.params
        g = generator(77)
        self.m = {n: 0.1 * normal(g, *p.shape).to(p) for n, p in self.params.items()}
        self.v = {n: uniform(g, 0.01, 0.1, *p.shape).to(p) for n, p in self.params.items()}
        if fresh:
            for moments in (self.m, self.v):
                for moment in moments.values():
                    moment.zero_()

    def tensors(self) -> dict[str, Tensor]:
        named = {"": self.params, "m of ": self.m, "v of ": self.v}
        return {prefix + n: t for prefix, group in named.items() for n, t in group.items()}

    def copy(self) -> dict[str, Tensor]:
        return {name: tensor.clone() for name, tensor in self.tensors().items()}

    def visible(self) -> Tensor:
        ids = self.scene.project(self.variant.ops).ids
        assert ids is not None
        return ids

    def step(
        self, packed_grad: Tensor, step: int = 1, ids: Tensor | None = None, **options: Any
    ) -> None:
        rates = {k: options.pop(k) for k in ("lr", "betas", "eps") if k in options}
        take_step(
            self.variant.ops,
            self.scene,
            self.m,
            self.v,
            self.visible() if ids is None else ids,
            packed_grad.to(self.variant.dtype),
            AdamRates(**{"lr": RATES, "step": step, **rates}),
            **options,
        )


def packed_grads(seed: int, count: int) -> Tensor:
    """A cotangent (M, 16), nonzero in every column: radii and padding must be ignored."""
    return normal(generator(seed), count, 16)


def test_step_matches_the_paper(variant: Variant) -> None:
    """Three steps of torch's Adam on the same gradients."""
    scene = random_scene(1, 25)
    state = Optimised(variant, scene, fresh=True)
    leaf = scene.to(torch.float64)
    leaves = [leaf.params[name] for name in PARAMETERS]
    adam = Adam(leaves, [RATES[name] for name in PARAMETERS], eps=1e-15)
    for step in (1, 2, 3):
        splats = leaf.project(reference)
        grad = packed_grads(10 + step, len(splats))
        adam.step(torch.autograd.grad(splats.packed, leaves, grad))
        state.step(grad, step)
    tolerance = max(variant.backward, 1e-9)  # eps is inside the root here, outside in torch
    for name, m, v in zip(PARAMETERS, adam.m, adam.v, strict=True):
        assert_close(state.params[name], leaf.params[name], tolerance, name)
        assert_close(state.m[name], m, tolerance, f"m of {name}")
        assert_close(state.v[name], v, tolerance, f"v of {name}")


@pytest.mark.parametrize("regularised", [False, True])
@pytest.mark.parametrize("visible_only", [False, True])
@pytest.mark.parametrize(("degree", "rest"), [(0, 0), (0, 15), (1, 3), (1, 15), (2, 8), (3, 15)])
def test_native_agrees_with_the_reference(
    native: Variant, degree: int, rest: int, visible_only: bool, regularised: bool
) -> None:
    """Three steps from given moments: every parameter and moment."""
    case = degree, rest, visible_only, regularised
    expected = three_steps_of_the_reference(*case)
    for name, change in three_steps(native, *case).items():
        assert_close(change, expected[name], native.backward, f"change of {name}")


def three_steps(
    variant: Variant, degree: int, rest: int, visible_only: bool, regularised: bool
) -> dict[str, Tensor]:
    """The change of every parameter and moment."""
    scene = random_scene(degree, 61, sh_degree=degree, rest=rest)
    state = Optimised(variant, scene)
    before = Optimised(REFERENCE, scene).copy()
    for step in (5, 6, 7):
        for k, (name, p) in enumerate(state.params.items()):
            # Only some parameters have a .grad: those with a regulariser.
            wanted = regularised and name in ("means", "opacity_logits", "sh_rest")
            p.grad = 0.1 * normal(generator(100 * step + k), *p.shape).to(p) if wanted else None
        ids = state.visible()
        state.step(packed_grads(step, len(ids)), step, ids, visible_only=visible_only)
    return {name: tensor.double() - before[name] for name, tensor in state.tensors().items()}


@functools.cache
def three_steps_of_the_reference(*case: Any) -> dict[str, Tensor]:
    """Computed once for all variants."""
    return three_steps(REFERENCE, *case)


def test_native_agrees_with_the_reference_if_antialiased(native: Variant) -> None:
    scene = random_scene(5, 200, pixels=0.5).antialiased()
    states = [Optimised(variant, scene) for variant in (REFERENCE, native)]
    before = states[0].copy()
    for state in states:
        state.step(packed_grads(2, len(state.visible())), 10)
    for name, expected in states[0].tensors().items():
        change = states[1].tensors()[name].double() - before[name]
        assert_close(change, expected - before[name], native.backward, name)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 16, 17, 33, 63, 64, 65, 129, 300, 5000])
def test_native_agrees_with_the_reference_for_any_count(native: Variant, count: int) -> None:
    before, after = a_step_of_the_reference(count)
    state = Optimised(native, random_scene(50 + count, count))
    state.step(packed_grads(1, len(state.visible())), 10)
    for name, tensor in state.tensors().items():
        change = tensor.double() - before[name]
        assert_close(change, after[name] - before[name], native.backward, name)


@functools.cache
def a_step_of_the_reference(count: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Every tensor before and after it, computed once for all variants."""
    state = Optimised(REFERENCE, random_scene(50 + count, count))
    before = state.copy()
    state.step(packed_grads(1, len(state.visible())), 10)
    return before, state.tensors()


def test_options_reach_the_step(native: Variant) -> None:
    """Other betas, a large eps, and learning rates of zero have the expected effect."""
    states = [Optimised(v, random_scene(2, 20)) for v in (REFERENCE, native)]
    before = states[0].copy()
    grad = packed_grads(1, len(states[0].visible()))
    rates = {**RATES, "quats": 0.0}
    for state in states:
        state.step(grad, 4, betas=(0.8, 0.9), eps=0.5, lr=rates)
    assert torch.equal(states[1].params["quats"].double(), before["quats"])
    for name, tensor in states[0].tensors().items():
        change = states[1].tensors()[name].double() - before[name]
        assert_close(change, tensor - before[name], native.backward, name)


def test_invisible_rows_stay_unchanged(variant: Variant) -> None:
    """visible_only: their values and moments keep every bit, even where a `.grad` is given."""
    state = Optimised(variant, random_scene(3, 40))
    ids = state.visible().long()
    hidden = torch.ones(40, dtype=torch.bool)
    hidden[ids] = False
    assert 0 < hidden.sum() < 40
    for p in state.params.values():
        p.grad = torch.ones_like(p)
    before = state.copy()
    state.step(packed_grads(0, len(ids)), visible_only=True)
    for name, tensor in state.tensors().items():
        assert torch.equal(tensor[hidden], before[name][hidden]), name
        assert not torch.equal(tensor[~hidden], before[name][~hidden]), name


def test_moments_of_invisible_rows_decay(variant: Variant) -> None:
    """Dense Adam: the gradient is 0, so m decays by β1, v by β2, and the value still changes."""
    state = Optimised(variant, random_scene(3, 40))
    ids = state.visible().long()
    hidden = torch.ones(40, dtype=torch.bool)
    hidden[ids] = False
    before = state.copy()
    state.step(packed_grads(0, len(ids)), step=3)
    for name in PARAMETERS:
        old_m, old_v = before[f"m of {name}"][hidden], before[f"v of {name}"][hidden]
        assert_close(state.m[name][hidden], 0.9 * old_m, 1e-6)
        assert_close(state.v[name][hidden], 0.999 * old_v, 1e-6)
        m_hat, v_hat = 0.9 * old_m / (1 - 0.9**3), 0.999 * old_v / (1 - 0.999**3)
        moved = state.params[name][hidden] - before[name][hidden]
        assert_close(moved, -RATES[name] * m_hat / v_hat.sqrt(), 1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_rows_of_inactive_degrees_stay_unchanged(variant: Variant, degree: int) -> None:
    state = Optimised(variant, random_scene(4, 20, sh_degree=degree))
    state.params["sh_rest"].grad = torch.ones_like(state.params["sh_rest"])
    before = state.copy()
    state.step(packed_grads(0, len(state.visible())))
    active = (degree + 1) ** 2 - 1
    for name in ("sh_rest", "m of sh_rest", "v of sh_rest"):
        tensor = state.tensors()[name]
        assert torch.equal(tensor[:, active:], before[name][:, active:]), name
        assert active == 0 or not torch.equal(tensor[:, :active], before[name][:, :active])


def test_gradient_of_a_regulariser_is_added(variant: Variant) -> None:
    """Without another gradient, it changes every value by its rate, visible or not."""
    state = Optimised(variant, random_scene(8, 20), fresh=True)
    before = state.copy()
    for p in state.params.values():
        p.grad = normal(generator(3), *p.shape).to(p)
    state.step(torch.zeros(len(state.visible()), 16))
    for name, p in state.params.items():
        assert p.grad is not None
        assert_close(p - before[name], -RATES[name] * p.grad.sign(), 1e-4, name)
        assert_close(state.m[name], 0.1 * p.grad, 1e-6, name)


def test_no_gaussian_is_visible(variant: Variant) -> None:
    state = Optimised(variant, random_scene(5, 10))
    state.params["means"] += torch.tensor([1e4, 0, 0])
    assert len(state.visible()) == 0
    before = state.copy()
    state.step(packed_grads(0, 0), visible_only=True)
    assert all(torch.equal(tensor, before[name]) for name, tensor in state.tensors().items())
    state.step(packed_grads(0, 0), step=2)
    assert_close(state.m["means"], 0.9 * before["m of means"], 1e-6)


@pytest.mark.parametrize("visible_only", [False, True])
def test_rows_without_a_gaussian(native: Variant, visible_only: bool) -> None:
    """On a GPU, splats of the id -1 are skipped; on the CPU, they are an error."""
    states = [Optimised(native, random_scene(3, 130)) for _ in range(2)]
    before = states[0].copy()
    ids = states[0].visible()
    grad = packed_grads(0, len(ids)).to(native.dtype)
    every_id = torch.full((130,), -1, dtype=torch.int32)
    every_id[ids.long()] = ids
    every_grad = torch.full((130, 16), math.nan, dtype=native.dtype)
    every_grad[ids.long()] = grad
    for state, rows, of_rows in zip(states, (ids, every_id), (grad, every_grad), strict=True):
        if native.engine == "native" and rows is every_id:
            with pytest.raises(ValueError, match="adam_step") as caught:
                state.step(of_rows, ids=rows, visible_only=visible_only)
            assert one_line(caught.value)
            assert all(torch.equal(t, before[name]) for name, t in state.tensors().items())
            return
        state.step(of_rows, ids=rows, visible_only=visible_only)
    for name, tensor in states[0].tensors().items():
        assert torch.equal(states[1].tensors()[name], tensor), name


def test_a_step_that_is_not_valid_changes_nothing(variant: Variant) -> None:
    """`valid` is on the device of the tensors."""
    states = [Optimised(variant, random_scene(3, 70)) for _ in range(3)]
    before = states[0].copy()
    grad = packed_grads(0, len(states[0].visible()))
    for state, valid in zip(
        states, (None, torch.tensor([True]), torch.tensor([False])), strict=True
    ):
        state.step(grad, valid=valid)
    for name, old in before.items():
        stepped, same, still = (state.tensors()[name] for state in states)
        assert torch.equal(same, stepped), name
        assert torch.equal(still, old), name


@pytest.mark.parametrize("rest", [0, 15])
def test_nonfinite_rows_are_counted_and_skipped(variant: Variant, rest: int) -> None:
    """A row counts once for each parameter in which a value is not finite."""
    degree = 0 if rest == 0 else 3
    state = Optimised(variant, random_scene(3, 40, sh_degree=degree, rest=rest))
    for name, values in (("means", [1, 1, 7]), ("quats", [5]), ("opacity_logits", [2, 9, 30])):
        p = state.params[name]
        p.grad = torch.zeros_like(p)
        for k, row in enumerate(values):
            p.grad.view(len(p), -1)[row, k % p[0].numel()] = math.inf
    before = state.copy()
    counts = torch.full((6,), 10, dtype=torch.int32)
    grad = packed_grads(0, len(state.visible()))
    state.step(grad, nonfinite_rows=counts)
    assert counts.tolist() == [12, 10, 11, 13, 10, 10]
    assert torch.equal(state.params["means"][1, 0], before["means"][1, 0])
    assert torch.equal(state.m["opacity_logits"][30], before["m of opacity_logits"][30])
    assert all(bool(tensor.isfinite().all()) for tensor in state.tensors().values())


def test_zero_moments_and_gradients_change_nothing(variant: Variant) -> None:
    """Zero moments and no gradient: 0 / √(0 + eps²) is 0, not NaN."""
    state = Optimised(variant, random_scene(6, 10), fresh=True)
    before = state.copy()
    state.step(torch.zeros(len(state.visible()), 16))
    assert all(torch.equal(tensor, before[name]) for name, tensor in state.tensors().items())


def step_with(change: dict[str, Any]) -> None:
    """`adam_step` of four Gaussians with some arguments, or items of arguments, replaced."""
    scene = random_scene(1, 4).to(torch.float32, requires_grad=False)
    params = scene.params | change.get("params", {})
    zeros = {n: torch.zeros_like(p) for n, p in scene.params.items()}
    m, v = ({**zeros, **change.get(name, {})} for name in ("exp_avg", "exp_avg_sq"))
    for moment in (m, v):
        moment.pop(change.get("missing", ""), None)
    ids = change.get("ids", torch.arange(2, dtype=torch.int32))
    grad = change.get("packed_grad", torch.zeros(2, 16))
    rates = AdamRates(change.get("lr", RATES), change.get("step", 1))
    take_step(ops, replace(scene, params=params), m, v, ids, grad, rates)


WRONG = {
    "ids without their gradient": {"packed_grad": torch.zeros(3, 16)},
    "gradient of another width": {"packed_grad": torch.zeros(2, 32)},
    "gradient of another dtype": {"packed_grad": torch.zeros(2, 16).double()},
    "ids of another type": {"ids": torch.arange(2)},
    "no first step": {"step": 0},
    "degree beyond the rows": {"params": {"sh_rest": torch.zeros(4, 8, 3)}},
    "a rate is missing": {"lr": {"means": 0.1}},
    "a moment is missing": {"missing": "means"},
    **{
        f"{group} of another {what}": {group: {"means": wrong}}
        for group in ("params", "exp_avg", "exp_avg_sq")
        for what, wrong in (("shape", torch.zeros(4, 4)), ("dtype", torch.zeros(4, 3).double()))
    },
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"^(adam_step|AdamRates): ") as caught:
        step_with(change)
    assert one_line(caught.value)
