"""`project_activated`: the reference, for any count; invalid input. See also `rasterization`."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Splats2D, reference

from .scenes import (
    Scene,
    Variant,
    assert_close,
    differentiable_columns,
    generator,
    normal,
    one_line,
    random_scene,
)


def arguments(scene: Scene, channels: int | None) -> dict[str, Tensor]:
    """The Gaussians after their activations, in float64. channels None: harmonics."""
    p = scene.params
    colors = torch.cat([p["sh_dc"], p["sh_rest"]], dim=1)
    if channels is not None:
        colors = normal(generator(4), len(colors), channels)
    return {
        "means": p["means"],
        "scales": p["log_scales"].exp(),
        "quats": p["quats"],
        "opacities": p["opacity_logits"].sigmoid(),
        "colors": colors,
    }


def splats_and_gradients(
    module: ModuleType, scene: Scene, given: dict[str, Tensor], dtype: torch.dtype
) -> tuple[Splats2D, dict[str, Tensor]]:
    leaves = {n: t.detach().to(dtype, copy=True).requires_grad_() for n, t in given.items()}
    pose = scene.cam_from_world.clone().requires_grad_()
    splats, means2d = module.project_activated(
        **leaves, view=replace(scene.view, cam_from_world=pose)
    )
    if module is ops:
        splats = ops.with_centres(splats, means2d)
    columns = differentiable_columns(splats)
    (columns * normal(generator(1), *columns.shape).to(dtype)).sum().backward()
    return splats, {n: t.grad for n, t in (leaves | {"pose": pose}).items() if t.grad is not None}


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("count", [1, 8, 17, 300])
@pytest.mark.parametrize("channels", [None, 2, 8, 20])
def test_kernels_match_the_reference(
    native: Variant, channels: int | None, count: int, antialiased: bool
) -> None:
    scene = random_scene(30 + count, count).looking(antialiased=antialiased)
    given = arguments(scene, channels)
    wanted, wanted_grads = splats_and_gradients(reference, scene, given, torch.float64)
    found, grads = splats_and_gradients(native.ops, scene, given, native.dtype)
    assert found.ids is not None
    assert wanted.ids is not None
    assert found.ids.tolist() == wanted.ids.tolist()
    assert found.channels == wanted.channels
    assert_close(found.packed, wanted.packed, native.forward)
    for name, grad in grads.items():
        assert_close(grad, wanted_grads[name], native.backward, name)


def test_no_gaussians(native: Variant) -> None:
    given = arguments(random_scene(1, 0), 3)
    splats, grads = splats_and_gradients(native.ops, random_scene(1, 0), given, native.dtype)
    assert splats.packed.shape == (0, 16)
    assert not grads["pose"].any()


WRONG = {
    "scales of another shape": {"scales": torch.zeros(4, 2)},
    "opacities as a column": {"opacities": torch.zeros(4, 1)},
    "mixed dtypes": {"quats": torch.zeros(4, 4)},
    "too few harmonics": {"colors": torch.zeros(4, 9, 3, dtype=torch.float64)},
    "harmonics of two channels": {"colors": torch.zeros(4, 16, 2, dtype=torch.float64)},
    "integers": {"means": torch.zeros(4, 3, dtype=torch.int32)},
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict[str, Any]) -> None:
    scene = random_scene(1, 4)
    with pytest.raises(ValueError, match=r"^project_activated: ") as caught:
        ops.project_activated(**arguments(scene, None) | change, view=scene.view)
    assert one_line(caught.value)
