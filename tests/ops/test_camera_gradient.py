"""`camera_gradient`: the backward pass of `project` to the pose and the focal length."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import SplatGradient, reference

from .scenes import Scene, Variant, assert_close, generator, normal, one_line, random_scene

#: The column of `Splats2D` that has no gradient: the radius.
RADIUS = 7


def cotangent(count: int) -> Tensor:
    """A gradient of splats (M, 16), nonzero in every column: the radii must be ignored."""
    return normal(generator(5), count, 16)


def gradient(variant: Variant, scene: Scene, **options: Any) -> tuple[Tensor, Tensor]:
    """For a fixed gradient of the splats."""
    scene = scene.to(variant.dtype, requires_grad=False)
    ids = scene.project(variant.ops).ids
    grad = cotangent(len(ids)).to(variant.dtype)
    return variant.ops.camera_gradient(
        scene.gaussians, SplatGradient(ids, grad), scene.view, **options
    )


def scene_of(count: int, degree: int = 3) -> Scene:
    return random_scene(90 + count, count, sh_degree=degree)


@pytest.mark.parametrize(
    ("degree", "antialiased"), [(0, False), (1, False), (2, False), (3, False), (1, True)]
)
def test_finite_differences(double: Variant, degree: int, antialiased: bool) -> None:
    """Of Σ cotangent · splats, in each of the 12 numbers of the pose, and in log f."""
    scene = scene_of(20, degree)
    scene = scene.looking(antialiased=antialiased)
    d_pose, d_focal = gradient(double, scene)
    seen = scene.project(reference)
    scene, grad = scene.rows(seen.ids.tolist()), cotangent(len(seen))
    grad[:, RADIUS] = 0.0

    def value(pose: Tensor, factor: float) -> float:
        focals = {"fx": factor * scene.view.fx, "fy": factor * scene.view.fy}
        splats = scene.looking(cam_from_world=pose, **focals).project(reference)
        assert len(splats) == len(grad)
        return float((splats.packed * grad).sum())

    pose, eps = scene.cam_from_world, 1e-6
    expected = torch.zeros(3, 4, dtype=torch.float64)
    for i in range(3):
        for j in range(4):
            step = torch.zeros(3, 4, dtype=torch.float64)
            step[i, j] = eps
            expected[i, j] = (value(pose + step, 1.0) - value(pose - step, 1.0)) / (2 * eps)
    assert_close(d_pose, expected, 1e-5)
    focal = (value(pose, math.exp(eps)) - value(pose, math.exp(-eps))) / (2 * eps)
    assert_close(d_focal, torch.tensor(focal), 1e-5)


@pytest.mark.parametrize("count", [1, 8, 65, 300])
def test_the_reference(native: Variant, count: int) -> None:
    wanted = gradient(Variant("reference", torch.float64, 1e-12, 1e-12), scene_of(count))
    for got, expected in zip(gradient(native, scene_of(count)), wanted, strict=True):
        assert got.dtype == torch.float64
        assert_close(got, expected, native.backward)


def test_the_gradient_of_the_pose_is_that_of_project(native: Variant) -> None:
    scene = scene_of(300).to(native.dtype)
    splats = scene.project(native.ops)
    splats.packed.backward(cotangent(len(splats)).to(native.dtype))
    assert scene.cam_from_world.grad is not None
    assert_close(gradient(native, scene_of(300))[0], scene.cam_from_world.grad, native.forward)


def test_the_sum_over_parts_is_exact(native: Variant) -> None:
    """Of any parts of the Gaussians, in any order, to the last bit."""
    scene = scene_of(300).to(native.dtype, requires_grad=False)
    ids = scene.project(native.ops).ids
    # A loss that is a mean over pixels has small gradients.
    grad = 1e-6 * cotangent(len(ids)).to(native.dtype)
    sums = []

    def part(rows: slice, over: Any) -> tuple[Tensor, Tensor]:
        gradient = SplatGradient(ids[rows].contiguous(), grad[rows].contiguous())
        return native.ops.camera_gradient(
            scene.gaussians, gradient, scene.view, over_processes=over
        )

    def keep(total: Tensor) -> Tensor:
        sums.append(total)
        return total

    whole = part(slice(None), None)
    for rows in (slice(0, 7), slice(40, None), slice(7, 40)):
        part(rows, keep)
    assert len(sums) == 3
    again = part(slice(0, 7), lambda first: first + (sums[1] + sums[2]))
    assert all(torch.equal(a, b) for a, b in zip(whole, again, strict=True))
    assert bool(whole[0].any())


def test_no_splats(native: Variant) -> None:
    scene = scene_of(8).to(native.dtype, requires_grad=False)
    none = SplatGradient(torch.zeros(0, dtype=torch.int32), torch.zeros(0, 16, dtype=native.dtype))
    d_pose, d_focal = native.ops.camera_gradient(scene.gaussians, none, scene.view)
    assert d_pose.shape == (3, 4)
    assert not d_pose.any()
    assert not d_focal.any()


WRONG = {
    "ids without their gradient": {"packed_grad": torch.zeros(3, 16)},
    "ids of another type": {"ids": torch.arange(2)},
    "a row without a Gaussian": {"ids": torch.tensor([-1, 0], dtype=torch.int32)},
    "no gradient": {"packed_grad": None},
}


@pytest.mark.isa
@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict[str, Any]) -> None:
    scene = random_scene(1, 4).to(torch.float32, requires_grad=False)
    ids = change.get("ids", torch.arange(2, dtype=torch.int32))
    gradient = SplatGradient(ids, change.get("packed_grad", torch.zeros(2, 16)))
    with pytest.raises(ValueError, match="^camera_gradient: ") as caught:
        ops.camera_gradient(scene.gaussians, gradient, scene.view)
    assert one_line(caught.value)
