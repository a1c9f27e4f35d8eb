"""`rasterize`: blends 2D splats into an image, front to back."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.ops.splats import COLORS, DEPTHS, Splats2D
from snowsplat.ops.sums import sum_of_rows

TILE = 16
_GROUP = 4  # channels that one pass of blending carries
_SLOT = 16  # numbers of the gradient of one splat in one tile


def rasterize(
    splats: Splats2D,
    width: int,
    height: int,
    background: Tensor | None = None,
    *,
    with_depth: bool = False,
    capacity: Capacity | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Blends splats, nearest first (equal depths by row), over `background` (C,), default black.

    Returns image (H, W, C) of planar storage, alpha (H, W), and depth (H, W) or None. With T the
    light that the splats in front let through and α = min(0.99, o exp(−½ dᵀ conic d)):
    image = Σ T α c + T_end · background, alpha = 1 − T_end, depth = Σ T α z (not divided by alpha).
    What is fainter than 1/255 is skipped; a pixel is finished when the next splat would leave less
    than 1e-4 of the light (Kerbl et al. 2023, section 6). Gradients flow to every column of
    `splats.packed` but the radii, and to `background`.

    With `capacity` the CPU does not wait for a GPU to count instances. On a GPU gradients are
    summed with atomics, in no fixed order, unless `torch.use_deterministic_algorithms` is set.

    Raises ValueError where shapes, dtypes or devices do not fit.
    """
    packed, channels = splats.packed, splats.channels
    check_float("rasterize", "splats", packed)
    check_size("rasterize", width, height)
    if background is None:
        background = packed.new_zeros(channels)
    check_tensor("rasterize", "background", background, (channels,), packed)
    planes, alpha = _Rasterize.apply(
        packed, background, width, height, channels, with_depth, capacity
    )
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
    frame = _Frame(packed, width, height, _channel_groups(1, False, packed.device)[0][1], None)
    counts = scratch.empty((height, width), packed.dtype, packed.device)
    launch(variant("blend_count", packed), frame.tiles, *frame.blend_args(), counts)
    return counts


class _Frame:
    """The splats of a frame sorted into tiles: what blending needs, forward and backward."""

    def __init__(
        self, packed: Tensor, width: int, height: int, columns: Tensor, capacity: Capacity | None
    ) -> None:
        count, stride = packed.shape
        device = packed.device
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        self.size, self.tiles = (width, height), tiles_x * tiles_y

        def empty(size: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return scratch.empty((size,), dtype, device)

        def ask(name: str, *args: int) -> int:
            return launch(name, *args, device=device)

        self.ordered_sums = ask("blend_sums_in_order", 0) == 1
        key = torch.int32 if packed.dtype == torch.float32 else torch.int64
        keys = empty(count, key)
        record_bytes = ask(variant("splat_record_bytes", packed), 0)
        self.splats = (packed, stride, columns, empty(count * record_bytes, torch.uint8))
        launch(
            variant("splats_prepare", packed),
            count,
            packed,
            stride,
            float(width),
            float(height),
            *self.splats[2:],
            keys,
        )
        order = empty(count)
        launch(variant("splats_sort", packed), count, keys, empty(count, key), order, empty(count))
        parts = ask("tiles_parts", count)
        workspace = empty(ask("tiles_workspace_bytes", count, self.tiles, parts), torch.uint8)
        self.tile_start = empty(self.tiles + 1)
        binning = (order, packed, stride, self.splats[3], tiles_x, tiles_y, parts, workspace)
        capacity = capacity or Capacity(-1, torch.empty(1, dtype=torch.int64, device=device))
        self.instances = launch(
            variant("tiles_count", packed),
            count,
            *binning,
            self.tile_start,
            capacity.instances,
            capacity.required,
        )
        self.instance_splat = empty(self.instances)
        self.instance_slot = empty(self.instances) if self.ordered_sums else None
        self.slot_range = empty(2 * count) if self.ordered_sums else None
        launch(
            variant("tiles_fill", packed),
            count,
            *binning,
            self.tile_start,
            self.instances,
            self.instance_splat,
            self.instance_slot,
            self.slot_range,
        )
        block_bytes = ask(variant("blend_block_bytes", packed), 0)
        self.instance_blocks = empty(self.instances * block_bytes, torch.uint8)
        self.tile_end = empty(self.tiles)

    def blend_args(self) -> tuple[int | Tensor, ...]:
        return (
            *self.size,
            *self.splats,
            self.tile_start,
            self.tile_end,
            self.instance_splat,
            self.instance_blocks,
        )

    def recolor(self, columns: Tensor) -> None:
        """From now on blend these columns."""
        packed, stride, _, records = self.splats
        self.splats = (packed, stride, columns, records)
        launch(variant("splats_recolor", packed), len(packed), *self.splats)


@functools.cache
def _channel_groups(
    channels: int, with_depth: bool, device: torch.device
) -> list[tuple[int, Tensor]]:
    """The packed columns that become image planes, up to four a pass, with their first plane."""
    columns = [COLORS + c for c in range(channels)] + ([DEPTHS] if with_depth else [])
    groups = []
    for first in range(0, len(columns), _GROUP):
        group = columns[first : first + _GROUP]
        group += [-1] * (_GROUP - len(group))
        groups.append((first, torch.tensor(group, dtype=torch.int64, device=device)))
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
        capacity: Capacity | None,
    ) -> tuple[Tensor, Tensor]:
        packed = packed.detach().contiguous()
        groups = _channel_groups(channels, with_depth, packed.device)
        count = channels + with_depth
        behind = torch.cat([background.detach(), packed.new_zeros(1)])  # nothing is behind depth
        planes = scratch.empty((count, height, width), packed.dtype, packed.device)
        alpha = scratch.empty((height, width), packed.dtype, packed.device)
        frame = _Frame(packed, width, height, groups[0][1], capacity)
        for first, columns in groups:
            if first > 0:
                frame.recolor(columns)
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
        ctx.save_for_backward(planes, alpha)
        ctx.frame, ctx.groups, ctx.channels = frame, groups, channels
        ctx.set_materialize_grads(False)
        return planes, alpha

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_planes: Tensor | None, grad_alpha: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        planes, alpha = ctx.saved_tensors
        frame, count = ctx.frame, len(planes)
        packed, stride = frame.splats[:2]
        if grad_planes is None:
            grad_planes = torch.zeros_like(planes)
        grad_planes = grad_planes.contiguous()
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        # Sums in a fixed order come from slots, one an instance; the others grow where they belong.
        grad_packed = scratch.empty(tuple(packed.shape), packed.dtype, packed.device)
        slots = None
        if frame.ordered_sums:
            slots = scratch.empty((frame.instances, _SLOT), packed.dtype, packed.device)
        else:
            grad_packed.zero_()
        for first, columns in ctx.groups:
            if len(ctx.groups) > 1:
                frame.recolor(columns)
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
                grad_packed,
            )
            if slots is not None:
                launch(
                    variant("splats_reduce", packed),
                    len(packed),
                    slots,
                    frame.slot_range,
                    packed,
                    stride,
                    carried,
                    columns,
                    first > 0,
                    grad_packed,
                )
        grad_background = None
        if ctx.needs_input_grad[1]:
            grad_background = _background_grad(grad_planes[: ctx.channels], alpha)
        return grad_packed, grad_background, None, None, None, None, None


def _background_grad(grad_image: Tensor, alpha: Tensor) -> Tensor:
    """(C,): the sum over pixels of ∂L/∂image · (1 − alpha)."""
    channels, height, width = grad_image.shape
    rows = torch.empty(height, channels, dtype=torch.float64, device=alpha.device)
    launch(
        variant("background_bwd", alpha),
        height,
        width,
        channels,
        grad_image.contiguous(),
        alpha,
        rows,
    )
    return sum_of_rows(rows).to(alpha.dtype)
