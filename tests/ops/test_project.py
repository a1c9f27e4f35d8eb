"""`project`: closed forms, visibility, finite differences, and native against the reference."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D

from .scenes import (
    PARAMETERS,
    Scene,
    Variant,
    as_float32,
    assert_close,
    differentiable_columns,
    generator,
    normal,
    one_line,
    random_scene,
    smooth_scene,
    tilted_pose,
    view_of,
)

IDENTITY = torch.eye(3, 4, dtype=torch.float64)
VIEW = view_of(IDENTITY, 40, 30, focal=50.0, sh_degree=0)


def single(
    mean: tuple[float, float, float],
    scales: tuple[float, float, float] = (0.1, 0.1, 0.1),
    quat: tuple[float, float, float, float] = (1, 0, 0, 0),
    logit: float = 1.0,
) -> Scene:
    """One Gaussian in front of a camera at the origin that looks along z."""
    tensor = partial(torch.tensor, dtype=torch.float64)
    params = {
        "means": tensor([mean]),
        "log_scales": tensor([scales]).log(),
        "quats": tensor([quat]),
        "opacity_logits": tensor([logit]),
        "sh_dc": tensor([[[0.5, -0.25, -9.0]]]),
        "sh_rest": torch.zeros(1, 0, 3, dtype=torch.float64),
    }
    return Scene(params, VIEW)


def covariance(conic: Tensor) -> Tensor:
    a, b, c = conic.double().tolist()
    return torch.linalg.inv(torch.tensor([[a, b], [b, c]], dtype=torch.float64))


def test_gaussian_on_the_axis(variant: Variant) -> None:
    scene = single((0, 0, 2), (0.1, 0.2, 0.4)).to(variant.dtype)
    splats = scene.project(variant.ops)
    assert splats.ids is not None
    assert splats.ids.tolist() == [0]
    assert splats.packed.shape == (1, 16)
    assert splats.packed.dtype == variant.dtype
    close = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-6, check_dtype=False)
    close(splats.means2d[0], torch.tensor([VIEW.cx, VIEW.cy]))
    # The variances are (f s / z)² + 0.3 and the depth axis of the Gaussian does not matter.
    sxx, syy = (VIEW.fx * 0.1 / 2) ** 2 + 0.3, (VIEW.fy * 0.2 / 2) ** 2 + 0.3
    close(splats.conics[0], torch.tensor([1 / sxx, 0, 1 / syy]))
    close(splats.opacities[0], torch.tensor(1 / (1 + math.exp(-1))))
    close(splats.depths[0], torch.tensor(2.0))
    close(splats.radii[0], torch.tensor(3 * math.sqrt(syy)))
    c0 = 0.5 / math.sqrt(math.pi)
    close(splats.colors[0], torch.tensor([0.5 + 0.5 * c0, 0.5 - 0.25 * c0, 0.0]))


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_an_antialiased_splat_keeps_its_integral(variant: Variant, size: float) -> None:
    """∫ α = 2π o √det Σ' is that of the splat without low-pass filter, 2π o (f s / z)²."""
    scene = single((0, 0, 2), (size, size, size), logit=2.0).antialiased()
    splats = scene.to(variant.dtype, requires_grad=False).project(variant.ops)
    a, b, c = splats.conics[0].double().tolist()
    integral = float(splats.opacities[0]) / math.sqrt(a * c - b * b)
    sharp = VIEW.fx * VIEW.fy * (size / 2) ** 2 / (1 + math.exp(-2))
    assert integral == pytest.approx(sharp, rel=1e-5)


def test_an_antialiased_splat_becomes_too_transparent_to_be_visible(variant: Variant) -> None:
    small = single((0, 0, 2), (1e-4, 1e-4, 1e-4)).to(variant.dtype)
    assert len(small.project(variant.ops)) == 1
    assert len(small.antialiased().project(variant.ops)) == 0


def test_quaternion_rotates_the_axes(variant: Variant) -> None:
    """wxyz: a rotation by 90° about z swaps x and y; by 45°, x → (x + y)/√2, with positive xy."""
    quarter, eighth = math.pi / 4, math.pi / 8
    turned = single((0, 0, 2), (0.2, 0.05, 0.1), (math.cos(quarter), 0, 0, math.sin(quarter)))
    plain = single((0, 0, 2), (0.05, 0.2, 0.1))
    conics = [s.to(variant.dtype).project(variant.ops).conics[0] for s in (turned, plain)]
    torch.testing.assert_close(conics[0], conics[1], rtol=1e-5, atol=1e-6)
    slanted = single((0, 0, 2), (0.2, 0.05, 0.1), (math.cos(eighth), 0, 0, math.sin(eighth)))
    assert covariance(slanted.to(variant.dtype).project(variant.ops).conics[0])[0, 1] > 1


def test_zero_quaternion_is_no_rotation(variant: Variant) -> None:
    plain = single((0.1, 0.2, 2), (0.2, 0.05, 0.1)).to(variant.dtype)
    zero = single((0.1, 0.2, 2), (0.2, 0.05, 0.1), (0, 0, 0, 0)).to(variant.dtype)
    splats = zero.project(variant.ops)
    assert_close(splats.packed, plain.project(variant.ops).packed, 1e-6)
    splats.packed.sum().backward()
    assert zero.params["quats"].grad is not None
    assert zero.params["quats"].grad.isfinite().all()


def test_isotropic_gaussian_off_the_axis(variant: Variant) -> None:
    x, y, z, s = 0.3, -0.2, 2.0, 0.15
    splats = single((x, y, z), (s, s, s)).to(variant.dtype).project(variant.ops)
    fx, fy = VIEW.fx, VIEW.fy
    J = torch.tensor([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]]).double()
    expected = s**2 * J @ J.T + 0.3 * torch.eye(2)
    assert_close(covariance(splats.conics[0]), expected, 1e-5)
    centre = torch.tensor([[fx * x / z + VIEW.cx, fy * y / z + VIEW.cy]])
    assert_close(splats.means2d, centre, 1e-6)


def test_jacobian_is_clamped_outside_of_the_image(variant: Variant) -> None:
    """The centre is at x/z = 1.5; the ratio in J is clamped 15% of the width beyond the border."""
    s, z = 1.0, 2.0
    splats = single((3.0, 0, z), (s, s, s)).to(variant.dtype).project(variant.ops)
    fx, fy, cx = VIEW.fx, VIEW.fy, VIEW.cx
    tx = (40 - cx + 0.15 * 40) / fx
    J = torch.tensor([[fx / z, 0, -fx * tx / z], [0, fy / z, 0]]).double()
    assert_close(covariance(splats.conics[0]), s**2 * J @ J.T + 0.3 * torch.eye(2), 1e-5)
    assert_close(splats.means2d[:, 0], torch.tensor([fx * 1.5 + cx]), 1e-6)


def test_visibility(variant: Variant) -> None:
    """Near plane, opacity, and the box of the ellipse {α ≥ 1/255} against the pixel centres."""
    cx, fx, z = VIEW.cx, VIEW.fx, 2.0
    sigma = math.sqrt((fx * 0.1 / z) ** 2 + 0.3)
    opacity = 1 / (1 + math.exp(-1))
    reach = math.sqrt(2 * math.log(255 * opacity)) * sigma

    def at_column(px: float) -> tuple[float, float, float]:
        return ((px - cx) * z / fx, 0.0, z)

    # Far outside, J grows with the angle; without the scale along z, y has no effect.
    scales = (0.1, 0.1, 1e-6)
    cases = [
        (single((0, 0, 2)), True),
        (single((0, 0, 0.2 + 1e-3)), True),
        (single((0, 0, 0.2 - 1e-3)), False),
        (single((0, 0, 0)), False),
        (single((0, 0, -2)), False),
        (single((0, 0, 2), logit=math.log(1 / 254) + 1e-3), True),
        (single((0, 0, 2), logit=math.log(1 / 254) - 1e-3), False),
        (single(at_column(0.5 - reach + 0.01), scales), True),
        (single(at_column(0.5 - reach - 0.01), scales), False),
        (single(at_column(39.5 + reach - 0.01), scales), True),
        (single(at_column(39.5 + reach + 0.01), scales), False),
    ]
    params = {n: torch.cat([scene.params[n] for scene, _ in cases]) for n in PARAMETERS}
    splats = Scene(params, VIEW).to(variant.dtype).project(variant.ops)
    assert splats.ids is not None
    assert splats.ids.dtype == torch.int32
    assert splats.ids.tolist() == [i for i, (_, visible) in enumerate(cases) if visible]


def test_near_is_an_argument(variant: Variant) -> None:
    scene = single((0, 0, 2)).to(variant.dtype)
    assert len(scene.project(variant.ops, near=1.99)) == 1
    assert len(scene.project(variant.ops, near=2.01)) == 0


def test_intrinsics_in_memory_replace_the_numbers(variant: Variant) -> None:
    scene = random_scene(3, 50).to(variant.dtype, requires_grad=False)
    memory = torch.tensor(
        [scene.view.fx, scene.view.fy, scene.view.cx, scene.view.cy], dtype=torch.float64
    )
    other = scene.looking(fx=1.0, fy=2.0, cx=3.0, cy=-4.0, intrinsics=memory)
    expected, found = scene.project(variant.ops), other.project(variant.ops)
    assert torch.equal(found.packed, expected.packed)
    assert torch.equal(found.ids, expected.ids)


def test_harmonics_match_the_definition() -> None:
    """Yₗₘ = (−1)ᵐ N Pₗ^|m|(cos θ) · {√2 sin |m|φ, 1, √2 cos mφ} for m < 0, m = 0, m > 0."""
    directions = normal(generator(0), 50, 3)
    directions = directions / directions.norm(dim=1, keepdim=True)
    x, y, z = directions.numpy().T
    phi = np.arctan2(y, x)
    expected = []
    for l in range(4):
        for m in range(-l, l + 1):
            k = abs(m)
            legendre = np.polynomial.Legendre.basis(l).deriv(k)(z) * (1 - z * z) ** (k / 2)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - k))
            norm /= math.sqrt(math.factorial(l + k))
            turn = 1.0 if m == 0 else math.sqrt(2) * (np.sin(k * phi) if m < 0 else np.cos(k * phi))
            expected.append(torch.tensor((-1) ** k * norm * legendre * turn))
    torch.testing.assert_close(reference.sh_basis(directions, 3), torch.stack(expected, dim=1))


def test_harmonics_of_degree_one_point_along_the_axes(variant: Variant) -> None:
    """The basis is −y, z, −x, times √(3/4π), of the direction from the camera in the world."""
    scene = single((0.4, -0.3, 2.0))
    scene.params["sh_dc"].zero_()
    scene.params["sh_rest"] = torch.eye(3, dtype=torch.float64)[None]  # one channel each
    scene = scene.looking(cam_from_world=tilted_pose())
    R, t = scene.cam_from_world[:, :3], scene.cam_from_world[:, 3]
    direction = scene.params["means"][0] - torch.linalg.solve(R, -t)
    x, y, z = (direction / direction.norm()).tolist()
    splats = scene.to(variant.dtype).project(variant.ops, sh_degree=1)
    expected = 0.5 + math.sqrt(3 / (4 * math.pi)) * torch.tensor([[-y, z, -x]])
    assert_close(splats.colors, expected, 1e-6)


def test_the_reference_computes_in_the_precision_of_the_means() -> None:
    """The pose is float64 in every precision."""
    scene = random_scene(1, 20)
    exact = scene.to(torch.float64).project(reference)
    rounded = scene.to(torch.float32).project(reference)
    assert rounded.packed.dtype == torch.float32
    assert_close(rounded.packed, exact.packed, 1e-4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_finite_differences(double: Variant, degree: int) -> None:
    scene = smooth_scene(degree, sh_degree=degree).rows([0, 3])
    rest = {0: 3, 1: 8}.get(degree, 15)  # more rows than the degree has, except for 3
    scene.params["sh_rest"] = scene.params["sh_rest"][:, :rest].contiguous()
    scene = scene.to(torch.float64)

    def columns(*leaves: Tensor) -> Tensor:
        return differentiable_columns(scene.of_leaves(*leaves).project(double.ops))

    leaves = tuple(scene.leaves().values())
    assert len(columns(*leaves)) == 2
    assert torch.autograd.gradcheck(columns, leaves, eps=1e-6, atol=1e-6, rtol=1e-6)


CASES = [
    (degree, rest) for rest in (0, 3, 8, 15) for degree in range(4) if (degree + 1) ** 2 <= rest + 1
]


@pytest.mark.parametrize(("degree", "rest"), CASES)
def test_native_agrees_with_the_reference(native: Variant, degree: int, rest: int) -> None:
    compare(native, random_scene(degree, 67, sh_degree=degree, rest=rest))


@pytest.mark.parametrize(
    "count", [0, 1, 2, 7, 8, 9, 15, 16, 17, 31, 33, 63, 64, 65, 129, 257, 5000]
)
def test_native_agrees_with_the_reference_for_any_count(native: Variant, count: int) -> None:
    compare(native, random_scene(40 + count, count))


@pytest.mark.parametrize("pixels", [0.1, 0.5, 2.0, 20.0])
def test_native_agrees_with_the_reference_if_antialiased(native: Variant, pixels: float) -> None:
    compare(native, random_scene(90, 300, pixels=pixels).antialiased())


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("length", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("shape", ["needle", "disc"])
def test_native_agrees_with_the_reference_for_long_thin_splats(
    native: Variant, shape: str, length: float, antialiased: bool
) -> None:
    """det Σ' as a difference cancels: with a σ of 1000 pixels, the error was 19% in float32."""
    if native.dtype == torch.float32:  # the error of a conic is proportional to the length
        native = replace(native, forward=3e-7 * length)
    scene = random_scene(3, 64, 64, 48)
    if antialiased:
        scene = scene.antialiased()
    R, t = scene.cam_from_world[:, :3], scene.cam_from_world[:, 3]
    depth = (scene.params["means"] @ R.T + t)[:, 2].abs()
    pixel = depth / scene.view.fx
    long, thin = (length * pixel).log(), (0.01 * pixel).log()
    scales = [long, thin, long if shape == "disc" else thin]
    scene.params["log_scales"] = as_float32(torch.stack(scales, dim=1))
    compare(native, scene)


def compare(native: Variant, scene: Scene) -> None:
    """Values and gradients of every input, with a random cotangent on every column."""
    parameters = tuple(p.numpy().tobytes() for p in scene.params.values())
    key = (parameters, scene.view.antialiased)
    if key not in _EXPECTED:
        _EXPECTED[key] = splats_and_gradients_of_the_reference(scene)
    (wanted, wanted_grads), actual = _EXPECTED[key], scene.to(native.dtype)
    got = actual.project(native.ops)
    assert wanted.ids is not None
    assert got.ids is not None
    assert got.ids.tolist() == wanted.ids.tolist()
    for name in ("means2d", "conics", "opacities", "depths", "radii", "colors"):
        assert_close(getattr(got, name), getattr(wanted, name), native.forward, name)
    if len(wanted) == 0:
        return
    (differentiable_columns(got) * cotangent_of(got).to(native.dtype)).sum().backward()
    for name, leaf in actual.leaves().items():
        assert leaf.grad is not None
        assert leaf.grad.dtype == leaf.dtype
        assert_close(leaf.grad, wanted_grads[name], native.backward, f"gradient of {name}")


#: Results of the reference, computed once for all variants.
_EXPECTED: dict[Any, tuple[Splats2D, dict[str, Tensor]]] = {}


def splats_and_gradients_of_the_reference(scene: Scene) -> tuple[Splats2D, dict[str, Tensor]]:
    leaf = scene.to(torch.float64)
    splats = leaf.project(reference)
    if len(splats) > 0:
        (differentiable_columns(splats) * cotangent_of(splats)).sum().backward()
    return splats, {name: p.grad for name, p in leaf.leaves().items() if p.grad is not None}


def cotangent_of(splats: Splats2D) -> Tensor:
    return normal(generator(1), len(splats), 7 + 3)


def test_only_requested_gradients_are_computed(native: Variant) -> None:
    scene = random_scene(6, 25).to(native.dtype, requires_grad=False)
    for required in (*PARAMETERS, "cam_from_world"):
        leaves = {n: t.detach().clone() for n, t in scene.leaves().items()}
        leaves[required].requires_grad_()
        splats = scene.of_leaves(*leaves.values()).project(native.ops)
        splats.packed.square().sum().backward()
        assert leaves[required].grad is not None
        assert leaves[required].grad.norm() > 0
    with torch.no_grad():
        assert not scene.project(native.ops).packed.requires_grad


def test_rows_beyond_the_degree_get_no_gradient(variant: Variant) -> None:
    scene = random_scene(7, 25, sh_degree=1).to(variant.dtype)
    scene.project(variant.ops).packed.square().sum().backward()
    grad = scene.params["sh_rest"].grad
    assert grad is not None
    assert grad[:, :3].norm() > 0
    assert grad[:, 3:].norm() == 0


def test_rows_of_invisible_gaussians_are_empty(native: Variant) -> None:
    """On a GPU, invisible Gaussians have rows of zeros, whose gradient is ignored.

    On the CPU there are no such rows.
    """
    scene = random_scene(9, 130).to(native.dtype)
    splats = native.ops.project(scene.gaussians, scene.view)
    expected = scene.to(torch.float64).project(reference).ids
    assert splats.ids is not None
    assert expected is not None
    seen = splats.ids >= 0
    assert splats.ids[seen].tolist() == expected.tolist()
    if native.engine == "native":
        assert seen.all()
    else:
        assert splats.ids.tolist() == torch.where(seen, torch.arange(130), -1).tolist()
        assert 0 < seen.sum() < 130
        assert (splats.packed[~seen] == 0).all()
    cotangent = normal(generator(1), len(splats), 16).to(native.dtype)
    cotangent[~seen] = math.nan
    splats.packed.backward(cotangent)
    hidden = torch.ones(130, dtype=torch.bool)
    hidden[expected.long()] = False
    for name, leaf in scene.leaves().items():
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all(), name
        assert name == "cam_from_world" or (leaf.grad[hidden] == 0).all(), name


def test_native_takes_any_strides(native: Variant) -> None:
    """Transposed and sliced tensors have the same results as contiguous ones."""
    scene = random_scene(8, 20).to(native.dtype, requires_grad=False)
    strided = {n: torch.stack([p, p], dim=-1)[..., 0] for n, p in scene.params.items()}
    assert not strided["means"].is_contiguous()
    got = replace(scene, params=strided).project(native.ops)
    assert torch.equal(got.packed, scene.project(native.ops).packed)


WRONG = {
    "means is not (N, 3)": {"means": torch.zeros(4, 2)},
    "log_scales is longer": {"log_scales": torch.zeros(5, 3)},
    "quats has three columns": {"quats": torch.zeros(4, 3)},
    "opacity_logits is a column": {"opacity_logits": torch.zeros(4, 1)},
    "sh_dc without its middle": {"sh_dc": torch.zeros(4, 3)},
    "sh_rest of 7 rows": {"sh_rest": torch.zeros(4, 7, 3)},
    "mixed dtypes": {"quats": torch.zeros(4, 4, dtype=torch.float64)},
    "integers": {"means": torch.zeros(4, 3, dtype=torch.int32)},
    "half": {"means": torch.zeros(4, 3, dtype=torch.float16)},
    "another device": {"means": torch.zeros(4, 3, device="meta")},
    "rows for degree 1, not 3": {"sh_rest": torch.zeros(4, 3, 3)},
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict) -> None:
    scene = random_scene(1, 4).to(torch.float32, requires_grad=False)
    with pytest.raises(ValueError, match="^project: ") as caught:
        ops.project(SimpleNamespace(**scene.params | change), scene.view)
    assert one_line(caught.value)


WRONG_VIEW = {
    "pose is 4 x 4": {"cam_from_world": torch.eye(4, dtype=torch.float64)},
    "no width": {"width": 0},
    "negative height": {"height": -3},
    "focal length 0": {"fx": 0.0},
    "focal length NaN": {"fy": math.nan},
    "principal point infinite": {"cx": math.inf},
    "degree 4": {"sh_degree": 4},
    "degree -1": {"sh_degree": -1},
    "near is not positive": {"near": 0.0},
    "near NaN": {"near": math.nan},
}


@pytest.mark.parametrize("change", WRONG_VIEW.values(), ids=WRONG_VIEW.keys())
def test_wrong_view(change: dict) -> None:
    with pytest.raises(ValueError, match="^View: ") as caught:
        replace(VIEW, **change)
    assert one_line(caught.value)
