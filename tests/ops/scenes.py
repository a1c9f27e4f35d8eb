"""Scenes, variants and comparisons for the tests of the ops.

All scenes are float64 tensors that float32 represents exactly. The difference between a float32 op
and its float64 reference is then only the rounding error of the op.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from snowsplat import ops
from snowsplat.ops import AdamRates, Moments, SplatGradient, Splats2D, View, reference

PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


@dataclass(frozen=True)
class Variant:
    """An implementation of the ops in one dtype, and its allowed relative errors.

    engine: "reference", "native" (the CPU's kernels), "emulated" (a GPU's kernels, on the CPU) or
    "cuda" (a GPU's kernels, on the GPU). Its tensors are on the CPU in each case: see `engines.py`.
    """

    engine: str
    dtype: torch.dtype
    forward: float
    backward: float

    @property
    def ops(self) -> ModuleType:
        return reference if self.engine == "reference" else ops

    def __str__(self) -> str:
        return f"{self.engine}-{str(self.dtype).removeprefix('torch.')}"


REFERENCE = Variant("reference", torch.float64, 1e-12, 1e-12)
NATIVE_FLOAT32 = Variant("native", torch.float32, 1e-4, 1e-3)
NATIVE_FLOAT64 = Variant("native", torch.float64, 1e-10, 1e-9)
EMULATED_FLOAT32 = replace(NATIVE_FLOAT32, engine="emulated")
EMULATED_FLOAT64 = replace(NATIVE_FLOAT64, engine="emulated")
CUDA_FLOAT32 = replace(NATIVE_FLOAT32, engine="cuda")
CUDA_FLOAT64 = replace(NATIVE_FLOAT64, engine="cuda")
WEBGPU_FLOAT32 = replace(NATIVE_FLOAT32, engine="webgpu")


#: Length of the longest images of the emulated kernels, in pixels; that of the others is 16384.
EMULATED_LENGTH = 10_000


@dataclass(frozen=True)
class Scene:
    """Gaussians and a camera: the arguments of `project`."""

    params: dict[str, Tensor]
    view: View  # its pose is float64 in every variant

    @property
    def gaussians(self) -> SimpleNamespace:
        return SimpleNamespace(**self.params)

    @property
    def cam_from_world(self) -> Tensor:
        return self.view.cam_from_world

    def looking(self, **changes: Any) -> Scene:
        """With another view."""
        return replace(self, view=replace(self.view, **changes))

    def to(self, dtype: torch.dtype, requires_grad: bool = True) -> Scene:
        """New leaf tensors of another dtype."""
        params = {
            name: p.detach().to(dtype, copy=True).requires_grad_(requires_grad)
            for name, p in self.params.items()
        }
        pose = self.cam_from_world.detach().clone().requires_grad_(requires_grad)
        return replace(self, params=params).looking(cam_from_world=pose)

    def project(self, module: ModuleType, **changes: Any) -> Splats2D:
        """Its splats, without empty rows."""
        splats = module.project(self.gaussians, replace(self.view, **changes))
        seen = splats.ids >= 0
        if bool(seen.all()):
            return splats
        return Splats2D(splats.packed[seen], splats.ids[seen], splats.channels)

    def antialiased(self) -> Scene:
        return self.looking(antialiased=True)

    def rows(self, rows: Sequence[int]) -> Scene:
        """Only these Gaussians."""
        return replace(self, params={name: p[list(rows)] for name, p in self.params.items()})

    def leaves(self) -> dict[str, Tensor]:
        return {**self.params, "cam_from_world": self.cam_from_world}

    def of_leaves(self, *leaves: Tensor) -> Scene:
        """With other tensors, in the order of `leaves()`."""
        params = dict(zip(self.params, leaves[:-1], strict=True))
        return replace(self, params=params).looking(cam_from_world=leaves[-1])

    @property
    def size(self) -> tuple[int, int]:
        return self.view.width, self.view.height


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(g: torch.Generator, *shape: int) -> Tensor:
    return as_float32(torch.randn(*shape, generator=g, dtype=torch.float64))


def uniform(g: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    u = torch.rand(*shape, generator=g, dtype=torch.float64)
    return as_float32(low + (high - low) * u)


def as_float32(values: Tensor) -> Tensor:
    """float64 values, rounded to the nearest values that float32 represents."""
    return values.float().double()


def take_step(
    module: ModuleType,
    scene: Scene,
    m: dict[str, Tensor],
    v: dict[str, Tensor],
    ids: Tensor,
    packed_grad: Tensor | None,
    rates: AdamRates,
    **options: Any,
) -> None:
    """`adam_step` of a scene."""
    gradient = SplatGradient(ids, packed_grad)
    module.adam_step(scene.gaussians, Moments(m, v), gradient, scene.view, rates, **options)


def view_of(
    pose: Tensor, width: int, height: int, focal: float | None = None, sh_degree: int = 3
) -> View:
    """An asymmetric camera: fx ≠ fy, the principal point is not at the centre."""
    focal = focal or 0.9 * max(width, height)
    focal = float(torch.tensor(focal).float())
    cx, cy = width / 2 + 0.25, height / 2 - 0.375
    return View(pose, width, height, focal, focal * 1.125, cx, cy, sh_degree)


def tilted_pose() -> Tensor:
    """cam_from_world (3, 4) with a rotation about a slanted axis and a shift."""
    axis = torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64)
    x, y, z = (0.4 * axis / axis.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    rotation = torch.matrix_exp(cross)
    shift = torch.tensor([[0.125], [-0.25], [0.5]], dtype=torch.float64)
    return as_float32(torch.cat([rotation, shift], dim=1))


def world_points(cam_from_world: Tensor, in_camera: Tensor) -> Tensor:
    """Points (N, 3) of camera space in the world."""
    rotation, shift = cam_from_world[:, :3], cam_from_world[:, 3]
    return as_float32((in_camera - shift) @ torch.linalg.inv(rotation).T)


def random_scene(
    seed: int,
    count: int,
    width: int = 23,
    height: int = 17,
    *,
    sh_degree: int = 3,
    rest: int = 15,
    pixels: float = 2.0,
) -> Scene:
    """Gaussians in the view and slightly beyond, with σ of about `pixels` pixels.

    Some lie behind the camera, some outside of the image, and some are too transparent.
    """
    g = generator(seed)
    pose = tilted_pose()
    view = view_of(pose, width, height, sh_degree=sh_degree)
    depth = uniform(g, 1.0, 6.0, count)
    depth[6::11] *= -1
    x = (uniform(g, -0.2, 1.2, count) * width - view.cx) / view.fx * depth
    y = (uniform(g, -0.2, 1.2, count) * height - view.cy) / view.fy * depth
    size = math.log(pixels / view.fx) + depth.abs().log()
    params = {
        "means": world_points(pose, torch.stack([x, y, depth], dim=1)),
        "log_scales": as_float32(size[:, None] + 0.6 * normal(g, count, 3)),
        "quats": normal(g, count, 4),
        "opacity_logits": as_float32(1.8 * normal(g, count)),
        "sh_dc": as_float32(0.8 * normal(g, count, 1, 3)),
        "sh_rest": as_float32(0.3 * normal(g, count, rest, 3)),
    }
    params["opacity_logits"][8::13] = -6.0
    return Scene(params, view)


def smooth_scene(seed: int = 0, sh_degree: int = 3) -> Scene:
    """Few broad Gaussians on a tiny image, tuned so that no threshold is near.

    In every pixel every α is well above 1/255 and below 0.99 and T well above 1e-4; the depths are
    far apart and the colours positive. The last one has its centre outside of the image, where the
    Jacobian is clamped.
    """
    g = generator(seed)
    pose = tilted_pose()
    view = view_of(pose, 5, 4, focal=5.0, sh_degree=sh_degree)
    in_camera = [[-0.3, 0.2, 1.5], [0.4, -0.3, 2.0], [0.1, 0.4, 2.6], [5.0, 0.3, 3.0]]
    params = {
        "means": world_points(pose, torch.tensor(in_camera, dtype=torch.float64)),
        "log_scales": uniform(g, -0.2, 0.4, 4, 3),
        "quats": normal(g, 4, 4),
        "opacity_logits": uniform(g, -0.5, 0.5, 4),
        "sh_dc": uniform(g, 0.2, 0.8, 4, 1, 3),
        "sh_rest": uniform(g, -0.05, 0.05, 4, 15, 3),
    }
    params["log_scales"][3] += 1.25
    return Scene(params, view)


def random_splats(
    seed: int,
    count: int,
    width: int,
    height: int,
    channels: int = 3,
    *,
    pixels: float = 2.5,
    opacity: tuple[float, float] = (0.02, 1.0),
) -> Splats2D:
    """Random 2D splats (float64) of different shapes, in an image and slightly beyond."""
    g = generator(seed)
    means2d = uniform(g, -0.1, 1.1, count, 2) * torch.tensor([width, height])
    angle = uniform(g, 0, math.pi, count)
    major = pixels * torch.exp(0.5 * normal(g, count))
    minor = major * uniform(g, 0.2, 1.0, count)
    cos, sin = angle.cos(), angle.sin()
    conics = [
        (cos / major) ** 2 + (sin / minor) ** 2,
        cos * sin * (major**-2 - minor**-2),
        (sin / major) ** 2 + (cos / minor) ** 2,
    ]
    return Splats2D.pack(
        as_float32(means2d),
        as_float32(torch.stack(conics, dim=1)),
        uniform(g, *opacity, count),
        uniform(g, 0.5, 8.0, count),
        uniform(g, -0.2, 1.0, count, channels),
    )


def leaf_splats(
    splats: Splats2D,
    dtype: torch.dtype,
    requires_grad: bool = True,
    with_abs_grad: bool = False,
) -> Splats2D:
    packed = splats.packed.detach().to(dtype, copy=True).requires_grad_(requires_grad)
    abs_grad = torch.zeros(len(splats), 2, dtype=dtype) if with_abs_grad else None
    return Splats2D(packed, splats.ids, splats.channels, abs_grad)


def differentiable_columns(splats: Splats2D) -> Tensor:
    """(M, 7 + C): all of `packed` but the radii, which have no gradient, and the padding."""
    s = splats
    scalars = torch.stack([s.opacities, s.depths], dim=1)
    return torch.cat([s.means2d, s.conics, scalars, s.colors], dim=1)


class Adam:
    """Torch's Adam. Its class torch.optim.Adam imports torch's compiler, which takes seconds."""

    def __init__(self, leaves: list[Tensor], rates: list[float], eps: float = 1e-8) -> None:
        self.leaves, self.rates, self.eps = leaves, rates, eps
        self.m, self.v = ([torch.zeros_like(leaf) for leaf in leaves] for _ in range(2))
        self.steps = [torch.zeros(()) for _ in leaves]

    @torch.no_grad()
    def step(self, grads: Sequence[Tensor]) -> None:
        rows = zip(self.leaves, grads, self.m, self.v, self.steps, self.rates, strict=True)
        for leaf, grad, m, v, step, rate in rows:
            adam(
                [leaf],
                [grad],
                [m],
                [v],
                [],
                [step],
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=rate,
                weight_decay=0,
                eps=self.eps,
                maximize=False,
            )


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """L2 norm of the difference, divided by that of the expected values unless it is 0."""
    assert actual.shape == expected.shape, f"{actual.shape} is not {expected.shape}"
    if expected.numel() == 0:
        return 0.0
    difference = (actual.double() - expected.double()).norm()
    return float(difference / (expected.double().norm() or 1.0))


def assert_close(actual: Tensor, expected: Tensor, tolerance: float, name: str = "") -> None:
    error = relative_error(actual.detach(), expected.detach())
    assert error <= tolerance, f"{name}: relative error {error:.2e} > {tolerance:.0e}"


def one_line(error: BaseException) -> bool:
    return 0 < len(str(error)) < 300 and "\n" not in str(error)
