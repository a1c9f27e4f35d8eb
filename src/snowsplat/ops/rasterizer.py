"""`rasterize`: composites 2D splats into an image, front to back."""

import functools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.ops import scratch
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import Struct, launch, query_size
from snowsplat.ops.projection import sum_of_rows
from snowsplat.ops.splats import COLORS, DEPTHS, Splats2D
from snowsplat.util.native_layout import GROUP_CHANNELS, SLOT_WIDTH, TILE


def rasterize(
    splats: Splats2D,
    width: int,
    height: int,
    background: Tensor | None = None,
    *,
    with_depth: bool = False,
    additive: bool = False,
    capacity: Capacity | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Composites splats over `background` (C,), which is black by default.

    The nearest splat is first; splats of equal depth are in the order of their rows. Returns image
    (H, W, C) with planar storage, alpha (H, W), and depth (H, W) or None:
    image = Σ T α c + T_end · background, alpha = 1 − T_end, depth = Σ T α z (not divided by alpha),
    where T is the transmittance of the splats in front and α = min(0.99, o exp(−½ dᵀ conic d)).
    Splats with α < 1/255 are skipped. A pixel is finished when the next splat would make T < 1e-4
    (Kerbl et al. 2023, section 6). Gradients flow to `background` and to every column of
    `splats.packed` except the radii. If `splats.abs_grad` is not None, the backward pass adds to it
    (see `Splats2D`), for each group of four channels, of which the depth is the last, separately.

    With `additive`, splats are added instead, in any order, as for the fitting of images by Zhang
    et al. 2024 (GaussianImage, arXiv:2403.08551): image = background + Σ w c, alpha = 0, depth =
    Σ w z, where w = o exp(−½ dᵀ conic d), not limited to 0.99. Splats with w < 1/255 are skipped.

    With `capacity`, the CPU does not wait until a GPU has counted the instances (see `Capacity`).
    On a GPU, gradients are summed with atomic operations, in no fixed order, unless
    `torch.use_deterministic_algorithms` is set.

    Raises ValueError if shapes, dtypes or devices do not match, or there are too many channels.
    """
    packed, channels, abs_grad = splats.packed, splats.channels, splats.abs_grad
    check_float("rasterize", "splats", packed)
    check_size("rasterize", width, height)
    if background is None:
        background = packed.new_zeros(channels)
    check_tensor("rasterize", "background", background, (channels,), packed)
    if abs_grad is not None:
        check_tensor("rasterize", "abs_grad", abs_grad, (len(packed), 2), packed)
    planes, alpha = _Rasterize.apply(
        packed, background, width, height, channels, with_depth, additive, capacity, abs_grad
    )
    if not with_depth:  # the gradient of a slice would be a copy
        return planes.permute(1, 2, 0), alpha, None
    return planes[:channels].permute(1, 2, 0), alpha, planes[channels]


@torch.no_grad()
def rasterize_median(splats: Splats2D, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """The colours of the splat at which the transmittance of each pixel falls below 1/2.

    Returns the median (H, W, C), the mean Σ T α c (H, W, C) and alpha (H, W), as in `rasterize`. In
    pixels with alpha < 1/2, the median is that of the last splat that is blended, or 0. With
    depths as colours, the median is not between two surfaces, as the mean is at the edges of
    objects. At most four channels.

    Raises ValueError if shapes or dtypes do not match, or there are too many channels.
    """
    packed, channels = splats.packed.detach().contiguous(), splats.channels
    check_float("rasterize_median", "splats", packed)
    check_size("rasterize_median", width, height)
    if channels > GROUP_CHANNELS:
        raise ValueError(f"rasterize_median: at most {GROUP_CHANNELS} channels, got {channels}")
    columns = _channel_groups(channels, False, packed.device)[0][1]
    frame = _bin_splats(packed, width, height, columns, False, None)
    planes = packed.new_empty(2, channels, height, width)
    alpha = packed.new_empty(height, width)
    launch(
        variant("rasterize_median", packed),
        n=frame.tiles,
        frame=frame.params,
        channels=channels,
        background=packed.new_zeros(channels),
        image=planes,
        alpha=alpha,
        states=None,
    )
    return planes[0].permute(1, 2, 0), planes[1].permute(1, 2, 0), alpha


@torch.no_grad()
def count_blended(splats: Splats2D, width: int, height: int) -> Tensor:
    """(H, W): the number of splats that `rasterize` composites into each pixel.

    Splats with α < 1/255 in a pixel are not counted. The splat that would make T < 1e-4 and all
    splats behind it are not counted either.

    Raises ValueError if shapes or dtypes do not match.
    """
    check_float("count_blended", "splats", splats.packed)
    check_size("count_blended", width, height)
    packed = splats.packed.detach().contiguous()
    columns = _channel_groups(1, False, packed.device)[0][1]
    frame = _bin_splats(packed, width, height, columns, False, None)
    counts = scratch.empty((height, width), packed.dtype, packed.device)
    launch(variant("rasterize_count", packed), n=frame.tiles, frame=frame.params, counts=counts)
    return counts


@dataclass
class _Frame:
    """The splats of a frame, sorted into tiles: the input of the forward and the backward pass."""

    params: Struct  # FrameParams in `native/params.h`
    tiles: int
    instances: int
    """Number of instances for which memory is allocated."""
    instance_slot: Tensor | None
    """The slot of each instance, and the slots of each splat, if the backward pass writes the
    gradient of each instance to memory of its own; see `_grad_packed`."""
    slot_range: Tensor | None


def _bin_splats(
    packed: Tensor,
    width: int,
    height: int,
    columns: Tensor,
    additive: bool,
    capacity: Capacity | None,
) -> _Frame:
    """Sorts splats by depth, counts the tiles that each splat touches, and lists splats by tile.

    columns: (4,) the columns of `packed` for the first group of channels; -1: unused.
    """
    n, stride = packed.shape
    device = packed.device
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tiles = tiles_x * tiles_y

    def empty(size: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return scratch.empty((size,), dtype, device)

    records = empty(n * query_size(variant("splat_record_bytes", packed), device), torch.uint8)
    order = _sort_by_depth(packed, width, height, columns, records)

    parts = query_size("tiles_parts", device, n)
    workspace_bytes = query_size("tiles_workspace_bytes", device, n, tiles, parts)
    binning = {
        "order": order,
        "packed": packed,
        "stride": stride,
        "records": records,
        "tiles_x": tiles_x,
        "tiles_y": tiles_y,
        "parts": parts,
        "workspace": empty(workspace_bytes, torch.uint8),
        "tile_start": empty(tiles + 1),
    }
    capacity = capacity or Capacity(-1, torch.empty(1, dtype=torch.int64, device=device))
    instances = launch(
        variant("tiles_count", packed),
        n=n,
        binning=binning,
        capacity=capacity.instances,
        required=capacity.required,
    )

    has_slots = query_size("rasterize_has_slots", device) == 1
    instance_splat = empty(instances)
    instance_slot = empty(instances) if has_slots else None
    slot_range = empty(2 * n) if has_slots else None
    launch(
        variant("tiles_fill", packed),
        n=n,
        binning=binning,
        capacity=instances,
        instance_splat=instance_splat,
        instance_slot=instance_slot,
        slot_range=slot_range,
    )

    block_bytes = query_size(variant("rasterize_block_bytes", packed), device)
    params = {
        "width": width,
        "height": height,
        "packed": packed,
        "stride": stride,
        "columns": columns,
        "records": records,
        "tile_start": binning["tile_start"],
        "tile_end": empty(tiles),
        "instance_splat": instance_splat,
        "instance_blocks": empty(instances * block_bytes, torch.uint8),
        "additive": additive,
    }
    return _Frame(params, tiles, instances, instance_slot, slot_range)


def _pixel_states(frame: _Frame, channels: int) -> Tensor:
    """Memory for the states of pixels at which the backward pass begins within a tile.

    The backward pass of a GPU cuts the list of a tile into segments, because otherwise the longest
    list would decide how long it takes. In float32, an instance needs 16 bytes for up to three
    channels, and 20 bytes for four.
    """
    packed = frame.params["packed"]
    boundaries = query_size("rasterize_boundaries", packed.device, frame.instances)
    shape = (boundaries, 1 + max(channels, 3), TILE * TILE)
    return scratch.empty(shape, packed.dtype, packed.device)


def _sort_by_depth(
    packed: Tensor, width: int, height: int, columns: Tensor, records: Tensor
) -> Tensor:
    """(M,): the rows of `packed`, nearest first. On the CPU, also fills `records`."""
    n, stride = packed.shape
    dtype = torch.int32 if packed.dtype == torch.float32 else torch.int64
    keys, keys2 = (scratch.empty((n,), dtype, packed.device) for _ in range(2))
    order, order2 = (scratch.empty((n,), torch.int32, packed.device) for _ in range(2))
    launch(
        variant("splats_prepare", packed),
        n=n,
        packed=packed,
        stride=stride,
        width=width,
        height=height,
        columns=columns,
        records=records,
        keys=keys,
    )
    launch(variant("splats_sort", packed), n=n, keys=keys, keys2=keys2, order=order, order2=order2)
    return order


def _with_channels(frame: _Frame, columns: Tensor) -> Struct:
    """The frame with other columns as its channels."""
    params = frame.params = frame.params | {"columns": columns}
    launch(
        variant("splats_recolor", params["packed"]),
        n=len(params["packed"]),
        columns=columns,
        **{name: params[name] for name in ("packed", "stride", "records")},
    )
    return params


@functools.cache
def _channel_groups(
    channels: int, with_depth: bool, device: torch.device
) -> list[tuple[int, Tensor]]:
    """For each pass: the index of its first image plane, and the packed columns (at most four)."""
    columns = [COLORS + c for c in range(channels)] + ([DEPTHS] if with_depth else [])
    groups = []
    for first in range(0, len(columns), GROUP_CHANNELS):
        group = columns[first : first + GROUP_CHANNELS]
        group += [-1] * (GROUP_CHANNELS - len(group))
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
        additive: bool,
        capacity: Capacity | None,
        abs_grad: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        packed = packed.detach().contiguous()
        groups = _channel_groups(channels, with_depth, packed.device)
        count = channels + with_depth
        # The background of the depth is 0.
        background = torch.cat([background.detach(), packed.new_zeros(1)])
        planes = scratch.empty((count, height, width), packed.dtype, packed.device)
        alpha = scratch.empty((height, width), packed.dtype, packed.device)
        frame = _bin_splats(packed, width, height, groups[0][1], additive, capacity)
        has_states = ctx.needs_input_grad[0] and not additive
        states = []
        for first, columns in groups:
            group_channels = min(GROUP_CHANNELS, count - first)
            states.append(_pixel_states(frame, group_channels) if has_states else None)
            launch(
                variant("rasterize_fwd", packed),
                n=frame.tiles,
                frame=frame.params if first == 0 else _with_channels(frame, columns),
                channels=group_channels,
                background=background[first:],
                image=planes[first:],
                alpha=alpha if first == 0 else None,
                states=states[-1],
            )
        ctx.save_for_backward(planes, alpha)
        ctx.frame, ctx.groups, ctx.states, ctx.channels = frame, groups, states, channels
        ctx.abs_grad = abs_grad
        ctx.set_materialize_grads(False)
        return planes, alpha

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_planes: Tensor | None, grad_alpha: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        planes, alpha = ctx.saved_tensors
        if grad_planes is None:
            grad_planes = torch.zeros_like(planes)
        grad_planes = grad_planes.contiguous()
        if ctx.frame.params["additive"]:
            grad_alpha = None  # alpha is always 0
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        grad_packed = _grad_packed(
            ctx.frame,
            ctx.groups,
            ctx.states,
            planes,
            grad_planes,
            alpha,
            grad_alpha,
            ctx.abs_grad,
        )
        grad_background = None
        if ctx.needs_input_grad[1]:
            grad_background = _grad_background(grad_planes[: ctx.channels], alpha)
        return grad_packed, grad_background, None, None, None, None, None, None, None


def _grad_packed(
    frame: _Frame,
    groups: list[tuple[int, Tensor]],
    states: list[Tensor | None],
    planes: Tensor,
    grad_planes: Tensor,
    alpha: Tensor,
    grad_alpha: Tensor | None,
    abs_grad: Tensor | None,
) -> Tensor:
    """The gradient of the splats, of the shape of `packed`. Also adds to `abs_grad`, if given.

    The CPU adds the gradients of a few tiles at a time, in a fixed order. A GPU adds them
    atomically. If their order must be fixed, it needs memory for all instances: the slots.
    """
    packed, stride = frame.params["packed"], frame.params["stride"]
    grad_packed = scratch.empty_like(packed)
    slots = None
    if frame.slot_range is not None:
        slots = scratch.empty((frame.instances, SLOT_WIDTH), packed.dtype, packed.device)
    else:
        grad_packed.zero_()
    for (first, columns), group_states in zip(groups, states, strict=True):
        channels = min(GROUP_CHANNELS, len(planes) - first)
        launch(
            variant("rasterize_bwd", packed),
            n=frame.tiles,
            frame=frame.params if len(groups) == 1 else _with_channels(frame, columns),
            channels=channels,
            instance_slot=frame.instance_slot,
            image=planes[first:],
            grad_image=grad_planes[first:],
            states=group_states,
            alpha=alpha,
            grad_alpha=grad_alpha if first == 0 else None,
            slots=slots,
            grad_packed=grad_packed,
            abs_grad=abs_grad,
        )
        if slots is not None and frame.slot_range is not None:
            launch(
                variant("splats_reduce", packed),
                n=len(packed),
                slots=slots,
                slot_range=frame.slot_range,
                packed=packed,
                stride=stride,
                channels=channels,
                columns=columns,
                add=first > 0,
                grad_packed=grad_packed,
                abs_grad=abs_grad,
            )
    return grad_packed


def _grad_background(grad_image: Tensor, alpha: Tensor) -> Tensor:
    """(C,): the sum over pixels of ∂L/∂image · (1 − alpha)."""
    channels, height, width = grad_image.shape
    rows = torch.empty(height, channels, dtype=torch.float64, device=alpha.device)
    launch(
        variant("background_bwd", alpha),
        n=height,
        width=width,
        channels=channels,
        grad_image=grad_image.contiguous(),
        alpha=alpha,
        rows=rows,
    )
    return sum_of_rows(rows).to(alpha.dtype)
