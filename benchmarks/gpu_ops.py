"""Runs every op once, forward and backward: the program for compute-sanitizer.

Scenes are small and have odd sizes, so blocks, warps and tiles are incomplete everywhere. The ops
run in both dtypes, with gradient sums by atomics and in a fixed order. Then a training step runs.
"""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest import mock

import torch
from gpu_step import Step, sums_in_order
from torch import Tensor
from workloads import Workload

from snowsplat import ops
from snowsplat.ops.cuda import tiling
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import view_of

#: Gaussians, width, height: from one of each to a few thousand, not multiples of block sizes.
SIZES = ((0, 1, 1), (1, 5, 3), (33, 17, 31), (999, 95, 53), (4099, 161, 99))
MEDIUM = SIZES[:-1]
SMALL = ((0, 1, 1), (1, 5, 3), (41, 19, 33))
WIDE = 16 * (1 << 16) + 5
#: Nothing can be recorded while torch allocates each tensor separately.
_GRAPHS = "PYTORCH_NO_CUDA_MEMORY_CACHING" not in os.environ


def every_op(
    device: torch.device,
    sizes: tuple[tuple[int, int, int], ...] = SIZES,
    wide: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Run all ops; announces each. ``wide``: also an image of many tiles.

    Raises:
        AssertionError: a result is not finite.
    """
    for count, width, height in sizes:
        scene = random_scene(count, width, height)
        # float64 has the same code, and would take half of the time at the largest size.
        for dtype in (torch.float32, torch.float64) if count < 4000 else (torch.float32,):
            for in_order in (False, True):
                name = f"{count} Gaussians, {width}x{height}, {dtype}, in order: {in_order}"
                say(f"ops: {name}")
                with sums_in_order(in_order):
                    _ops_of(scene, device, dtype)
        _neighbours(scene.gaussians.means, device)
        _plane_sweep(width, height, device)
        _geometry(scene, device)
        if count > 0:
            for in_order in (False, True):
                say(f"training: {count} Gaussians, {width}x{height}, in order: {in_order}")
                with sums_in_order(in_order):
                    # The capacity is too small at first, so lists are truncated.
                    step = Step(scene, device, capacity=max(1, count // 2))
                    if not _GRAPHS:
                        step.trainer.graphs = None
                    for _ in range(3):  # too small, sufficient, as CUDA graphs
                        assert math.isfinite(step.run())
    say("ops: lists of tiles in several segments")
    for in_order in (False, True):
        with sums_in_order(in_order):
            _ops_of(random_scene(1200, 20, 18), device, torch.float32)
    say("ops: sorts as for many keys, of several blocks, too")
    with mock.patch.multiple(tiling, FEW=0, MOST_ADDED=0):
        _ops_of(random_scene(*sizes[2]), device, torch.float32)
        ops.neighbours(torch.rand(2100, 3).to(device), 1)
    if wide:
        say(f"ops: {WIDE} pixels in a row, more tiles than 16 bits count")
        _ops_of(random_scene(100, WIDE, 1), device, torch.float32)


def random_scene(count: int, width: int, height: int) -> Workload:
    """Gaussians inside and outside of the view, some behind the camera, a few large ones."""
    g = torch.Generator().manual_seed(count)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=g)

    focal = 0.9 * max(width, height)
    depth = uniform(1, 6)
    depth[6::11] *= -1
    x = (uniform(-0.2, 1.2) - 0.5) * width / focal * depth
    y = (uniform(-0.2, 1.2) - 0.5) * height / focal * depth
    size = (3 / focal * depth.abs()).log()
    size[::17] += 2
    gaussians = Gaussians(
        means=torch.stack([x, y, depth], dim=1),
        log_scales=size[:, None] + uniform(-1, 1, 3),
        quats=uniform(-1, 1, 4),
        opacity_logits=uniform(-4, 4),
        sh_dc=uniform(-1, 1, 1, 3),
        sh_rest=uniform(-0.3, 0.3, 15, 3),
    )
    pose = torch.eye(4, dtype=torch.float64)[:3]
    camera = Camera(width, height, focal, 1.1 * focal, width / 2 + 0.3, height / 2 - 0.4, pose)
    return Workload("random", "random Gaussians", gaussians, camera)


def _ops_of(scene: Workload, device: torch.device, dtype: torch.dtype) -> None:
    camera = scene.camera
    size = camera.width, camera.height
    gaussians = scene.gaussians.map(lambda p: p.to(device, dtype, copy=True).requires_grad_())
    params = gaussians.parameters()
    pose = camera.cam_from_world.to(device, dtype, copy=True).requires_grad_()
    view = view_of(gaussians, replace(camera, cam_from_world=pose))
    background = torch.rand(3, device=device, dtype=dtype).requires_grad_()

    # Gradients down to the parameters and the pose; depth is a second group of channels.
    splats = ops.project(gaussians, view)
    image, alpha, depth = ops.rasterize(splats, *size, background, with_depth=True)
    assert depth is not None
    photo = torch.rand(3, camera.height, camera.width, device=device, dtype=dtype).permute(1, 2, 0)
    loss = ops.photometric_loss(image, photo) + (1 - ops.ssim(image, photo))
    (loss + alpha.mean() + depth.mean()).backward()
    _finite(loss, background.grad, pose.grad, *(p.grad for p in params.values()))

    # As in a training step: the gradient of the splats, at a lower degree.
    with torch.no_grad():
        view = replace(view, cam_from_world=pose.detach(), sh_degree=1)
        splats = ops.project(gaussians, view)
        splats.packed.requires_grad_()
        splats.abs_grad = torch.zeros(len(splats), 2, device=device, dtype=dtype)
        with torch.enable_grad():
            image, _, _ = ops.rasterize(splats, *size, background.detach())
            target = (255 * photo).to(torch.uint8)
            ops.photometric_loss(image, target, huber_weight=10.0).backward()
        many = [torch.zeros(len(scene.gaussians), device=device, dtype=dtype) for _ in range(3)]
        for absolute in (False, True):
            ops.accumulate_screen_statistics(splats, *size, *many, absolute=absolute)
        moments: Any = [{name: torch.zeros_like(p) for name, p in params.items()} for _ in range(2)]
        gradient = splats.packed.grad
        assert gradient is not None
        assert splats.ids is not None
        rows = torch.arange(len(splats), device=device)[splats.ids >= 0]
        for visible_only, valid, ids, grad in (
            (False, None, splats.ids, gradient),
            (True, torch.ones(1, dtype=torch.bool, device=device), splats.ids, gradient),
            (True, None, splats.ids[rows], gradient[rows]),
        ):
            ops.adam_step(
                gaussians,
                ops.Moments(*moments),
                ops.SplatGradient(ids, grad),
                view,
                ops.AdamRates(dict.fromkeys(params, 1e-3), 1),
                visible_only=visible_only,
                valid=valid,
            )
            for p in params.values():
                p.grad = None
        limits = {"sharpness": 100.0, "opacity": 0.5, "negligible": 1e-4}
        ops.add_noise(gaussians, 1e-3, **limits, seed=1, first=3)
        counts = ops.count_blended(splats, *size)
        median, mean, alpha = ops.rasterize_median(splats, *size)
    _finite(median, mean, alpha, counts, splats.abs_grad, *many, *params.values())


def _neighbours(means: Tensor, device: torch.device) -> None:
    for dtype in (torch.float32, torch.float64):
        for k in (1, 3, 8, 64):
            ops.neighbours(means.to(device, dtype), k)


def _plane_sweep(width: int, height: int, device: torch.device) -> None:
    for dtype in (torch.float32, torch.float64):
        image = torch.rand(height, width, dtype=dtype).to(device)
        sources = torch.rand(3, height + 1, width + 2, dtype=dtype).to(device)
        matrix = torch.eye(3, 4, dtype=dtype).repeat(3, 1, 1)
        matrix[:, 0, 3] = torch.tensor([3.0, -2.0, 1.0])
        matrix = matrix.to(device)
        for radius, centre in ((1, None), (7, torch.zeros_like(image))):
            _finite(
                *ops.plane_sweep(
                    image, sources, matrix, 0.0, 1.0, planes=3, radius=radius, centre=centre
                )
            )


def _geometry(scene: Workload, device: torch.device) -> None:
    """The Gaussians' means in cameras, and a depth map in cubes of samples and in single points."""
    camera, means = scene.camera, scene.gaussians.means
    width, height = camera.width, camera.height
    for dtype in (torch.float32, torch.float64):
        points = means.to(device, dtype)
        to_image = (camera.intrinsics @ camera.cam_from_world).to(device, dtype)
        frusta = ops.Frusta(
            to_image.expand(3, 3, 4).contiguous(),
            torch.tensor([width, height], dtype=dtype, device=device).expand(3, 2).contiguous(),
            torch.tensor([[0.1, 9], [0.1, 2], [3, 4]], dtype=dtype, device=device),
            torch.full((3,), camera.fx, dtype=dtype, device=device),
        )
        _finite(*ops.points_in_frusta(points, frusta))
        _finite(*ops.points_in_spheres(points, torch.rand(3, 4, dtype=dtype).to(device)))
        depth = 1 + 5 * torch.rand(height, width, dtype=dtype).to(device)
        weight = torch.rand(height, width, dtype=dtype).to(device)
        image = torch.rand(3, height, width, dtype=dtype).to(device)
        for side, photo in ((8, None), (1, image)):
            channels = 2 if photo is None else 5
            sums = points.new_zeros(len(points), side, side, side, channels)
            ops.fuse_depth(sums, points, 0.05, to_image, depth, weight, 0.2, photo)
            _finite(sums)


def _finite(*tensors: Tensor | None) -> None:
    for tensor in tensors:
        assert tensor is not None
        assert bool(tensor.isfinite().all()), "a result is not finite"
