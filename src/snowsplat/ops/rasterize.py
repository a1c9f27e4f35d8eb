"""`rasterize`: blends 2D splats into an image, front to back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.splats import COLORS, DEPTHS, Splats2D

TILE = 16
_GROUP = 4  # channels that one pass of blending carries
_RECORD_BYTES = {torch.float32: 64, torch.float64: 128}
_SLOT = 16  # numbers of the gradient of one splat in one tile


def rasterize(
    splats: Splats2D,
    width: int,
    height: int,
    background: Tensor | None = None,
    *,
    with_depth: bool = False,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Blends splats, nearest first (equal depths by row), over `background` (C,), default black.

    Returns image (H, W, C) of planar storage, alpha (H, W), and depth (H, W) or None. With T the
    light that the splats in front let through and α = min(0.99, o exp(−½ dᵀ conic d)):
    image = Σ T α c + T_end · background, alpha = 1 − T_end, depth = Σ T α z (not divided by alpha).
    What is fainter than 1/255 is skipped; a pixel is finished when the next splat would leave less
    than 1e-4 of the light (Kerbl et al. 2023, section 6). Gradients flow to every column of
    `splats.packed` but the radii, and to `background`.

    Raises ValueError where shapes, dtypes or devices do not fit.
    """
    packed, channels = splats.packed, splats.channels
    check_float("rasterize", "splats", packed)
    check_size("rasterize", width, height)
    if background is None:
        background = packed.new_zeros(channels)
    check_tensor("rasterize", "background", background, (channels,), packed)
    planes, alpha = _Rasterize.apply(packed, background, width, height, channels, with_depth)
    depth = planes[channels] if with_depth else None
    return planes[:channels].permute(1, 2, 0), alpha, depth


@torch.no_grad()
def count_blended(splats: Splats2D, width: int, height: int) -> Tensor:
    """(H, W) how many splats `rasterize` blends into each pixel, which is what it costs.

    Not counted: those fainter than 1/255 there, and those behind where the pixel is finished.

    Raises ValueError where shapes or dtypes do not fit.
    """
    check_float("count_blended", "splats", splats.packed)
    check_size("count_blended", width, height)
    packed = splats.packed.detach().contiguous()
    frame = _Frame(packed, width, height, _channel_groups(1, False)[0][1])
    counts = scratch.empty((height, width), packed.dtype)
    launch(variant("blend_count", packed), frame.tiles, *frame.blend_args(), counts)
    return counts


class _Frame:
    """The splats of a frame sorted into tiles: what blending needs, forward and backward."""

    def __init__(self, packed: Tensor, width: int, height: int, columns: Tensor) -> None:
        count, stride = packed.shape
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        self.size, self.tiles = (width, height), tiles_x * tiles_y
        integers = torch.int32
        keys = scratch.empty((count,), integers if packed.dtype == torch.float32 else torch.int64)
        self.records = scratch.empty((count * _RECORD_BYTES[packed.dtype],), torch.uint8)
        launch(
            variant("splats_prepare", packed),
            count,
            packed,
            stride,
            float(width),
            float(height),
            columns,
            self.records,
            keys,
        )
        order = scratch.empty((count,), integers)
        launch(
            variant("splats_sort", packed),
            count,
            keys,
            scratch.empty((count,), keys.dtype),
            order,
            scratch.empty((count,), integers),
        )
        parts = launch("tiles_parts", count)
        counts = scratch.empty((parts * self.tiles,), integers)
        spans = scratch.empty((count,), torch.int64)
        part_slots = scratch.empty((parts,), integers)
        self.tile_start = scratch.empty((self.tiles + 1,), integers)
        binning = (order, self.records, tiles_x, tiles_y, parts, counts)
        self.instances = launch(
            variant("tiles_count", packed),
            count,
            *binning,
            self.tile_start,
            spans,
            part_slots,
        )
        self.instance_splat = scratch.empty((self.instances,), integers)
        self.instance_slot = scratch.empty((self.instances,), integers)
        self.slot_range = scratch.empty((2 * count,), integers)
        launch(
            variant("tiles_fill", packed),
            count,
            *binning,
            spans,
            part_slots,
            self.instance_splat,
            self.instance_slot,
            self.slot_range,
        )
        block_bytes = launch(variant("blend_block_bytes", packed), 0)
        self.instance_blocks = scratch.empty((self.instances * block_bytes,), torch.uint8)
        self.tile_end = scratch.empty((self.tiles,), integers)

    def blend_args(self) -> tuple[int | Tensor, ...]:
        return (
            *self.size,
            self.records,
            self.tile_start,
            self.tile_end,
            self.instance_splat,
            self.instance_blocks,
        )


def _channel_groups(channels: int, with_depth: bool) -> list[tuple[int, Tensor]]:
    """The packed columns that become image planes, up to four a pass, with their first plane."""
    columns = [COLORS + c for c in range(channels)] + ([DEPTHS] if with_depth else [])
    groups = []
    for first in range(0, len(columns), _GROUP):
        group = columns[first : first + _GROUP]
        group += [-1] * (_GROUP - len(group))
        groups.append((first, torch.tensor(group, dtype=torch.int64)))
    return groups


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        packed: Tensor,
        background: Tensor,
        width: int,
        height: int,
        channels: int,
        with_depth: bool,
    ) -> tuple[Tensor, Tensor]:
        packed = packed.detach().contiguous()
        groups = _channel_groups(channels, with_depth)
        count = channels + with_depth
        behind = torch.cat([background.detach(), packed.new_zeros(1)])  # nothing is behind depth
        planes = scratch.empty((count, height, width), packed.dtype)
        alpha = scratch.empty((height, width), packed.dtype)
        frame = _Frame(packed, width, height, groups[0][1])
        for first, columns in groups:
            if first > 0:
                _recolor(frame, packed, columns)
            carried = min(_GROUP, count - first)
            launch(
                variant("blend_fwd", packed),
                frame.tiles,
                *frame.blend_args(),
                carried,
                behind[first:],
                planes[first:],
                alpha if first == 0 else None,
            )
        ctx.save_for_backward(packed, planes, alpha)
        ctx.frame, ctx.groups, ctx.channels = frame, groups, channels
        ctx.set_materialize_grads(False)
        return planes, alpha

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_planes: Tensor | None, grad_alpha: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        packed, planes, alpha = ctx.saved_tensors
        frame, count = ctx.frame, len(planes)
        if grad_planes is None:
            grad_planes = torch.zeros_like(planes)
        grad_planes = grad_planes.contiguous()
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        grad_packed = scratch.empty(tuple(packed.shape), packed.dtype)
        slots = scratch.empty((frame.instances, _SLOT), packed.dtype)
        for first, columns in ctx.groups:
            if len(ctx.groups) > 1:
                _recolor(frame, packed, columns)
            carried = min(_GROUP, count - first)
            launch(
                variant("blend_bwd", packed),
                frame.tiles,
                *frame.blend_args(),
                carried,
                frame.instance_slot,
                planes[first:],
                grad_planes[first:],
                alpha,
                grad_alpha if first == 0 else None,
                slots,
            )
            launch(
                variant("splats_reduce", packed),
                len(packed),
                slots,
                frame.slot_range,
                packed,
                packed.shape[1],
                carried,
                columns,
                first > 0,
                grad_packed,
            )
        grad_background = None
        if ctx.needs_input_grad[1]:
            grad_background = _background_grad(grad_planes[: ctx.channels], alpha)
        return grad_packed, grad_background, None, None, None, None


def _recolor(frame: _Frame, packed: Tensor, columns: Tensor) -> None:
    name = variant("splats_recolor", packed)
    launch(name, len(packed), packed, packed.shape[1], columns, frame.records)


def _background_grad(grad_image: Tensor, alpha: Tensor) -> Tensor:
    """(C,): the sum over pixels of ∂L/∂image · (1 − alpha)."""
    channels, height, width = grad_image.shape
    rows = torch.empty(height, channels, dtype=torch.float64)
    launch(
        variant("background_bwd", alpha),
        height,
        width,
        channels,
        grad_image.contiguous(),
        alpha,
        rows,
    )
    total = torch.zeros(channels, dtype=torch.float64)
    for row in rows:  # in order, whatever torch's number of threads
        total += row
    return total.to(alpha.dtype)
