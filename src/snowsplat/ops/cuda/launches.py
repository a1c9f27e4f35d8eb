"""The native functions on a GPU: one kernel each, or a sequence of kernels."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from snowsplat.ops.cuda import driver
from snowsplat.ops.cuda.kernels import KERNELS, NEIGHBOUR_LISTS, SWEEP_EDGE, Kernel, Run
from snowsplat.ops.cuda.tiling import (
    sort_pairs,
    splats_sort,
    tiles_count,
    tiles_fill,
    workspace_bytes,
)
from snowsplat.util.native_layout import POSE_SUMS, SEGMENT, Fields

Execute = Callable[[Kernel, str, int, Fields], None]
"""Runs a kernel. Arguments: the kernel, its full name, the number of blocks, the parameters."""
_TILE_WIDTH = 32
_TILE_HEIGHT = {"": 24, "_f64": 12}
_MAPS_BYTES = 32 << 20  # maximum size of the maps of derivatives, if at least one channel fits
_CHUNK = 32  # points of a chunk; also chunks of a group
_CODE_BITS = 63


def launch(name: str, fields: Fields) -> int:
    """`native.launch` for tensors on a GPU: queues the kernels on torch's current stream.

    Raises: UserError: the GPU cannot be used; the message says why.
    """
    return launch_by(driver.run, name, fields)


def launch_by(execute: Execute, name: str, fields: Fields) -> int:
    """As `launch`, with `execute` instead of the GPU's driver."""

    def run(kernel_name: str, of_kernel: Fields, blocks: int | None = None) -> None:
        kernel = KERNELS[kernel_name.removesuffix("_f64")]
        count = kernel.blocks(of_kernel["n"]) if blocks is None else blocks
        if count > 0:
            execute(kernel, kernel_name, count, of_kernel)

    base = name.removesuffix("_f64")
    if base in SEQUENCES:
        return SEQUENCES[base](run, name[len(base) :], fields)
    run(name, fields)
    return 0


def _project_cull(run: Run, suffix: str, p: Fields) -> int:
    """Returns the number of all rows; the id of a Gaussian that is not visible is −1."""
    run("project_cull" + suffix, p)
    return int(p["n"])


def _project_bwd(run: Run, suffix: str, p: Fields) -> int:
    pose = p["pose"]
    if pose is None:
        run("project_bwd" + suffix, p)
        return 0
    blocks = KERNELS["project_bwd"].blocks(p["n"])
    sums = torch.empty(blocks, POSE_SUMS, dtype=torch.float64, device=pose.device)
    run("project_bwd" + suffix, {**p, "pose": sums})
    run("project_pose_sum", {"n": blocks, "sums": sums, "pose": pose}, min(blocks, 1))
    return 0


def _adam_step(run: Run, suffix: str, p: Fields) -> int:
    # If `project` returned all rows, the ids have a row for each Gaussian: −1 if it is not visible.
    n, splats, ids = p["n"], p["splats"], p["ids"]
    splat_of = ids
    if splats != n:
        splat_of = torch.full((n,), -1, dtype=torch.int32, device=ids.device)
        run("adam_splat_of", {"n": splats, "ids": ids, "gaussians": n, "splat_of": splat_of})
    run("adam_update" + suffix, {**p, "ids": splat_of})
    return 0


def _has_slots(run: Run, suffix: str, p: Fields) -> int:
    """Sums in a fixed order need memory and time, so they are used only if torch is set to it."""
    return int(torch.are_deterministic_algorithms_enabled())


def _boundaries(instances: int) -> int:
    """The segments of all tiles of `rasterize_bwd`, without the first one of each tile, at most."""
    return max(0, instances - 1) // SEGMENT


def _rasterize_bwd(run: Run, suffix: str, p: Fields) -> int:
    boundaries = _boundaries(len(p["frame.instance_splat"]))
    run("rasterize_bwd" + suffix, p, p["n"] + boundaries)
    return 0


def _plane_sweep(run: Run, suffix: str, p: Fields) -> int:
    blocks = -(-p["width"] // SWEEP_EDGE) * -(-p["height"] // SWEEP_EDGE)
    run("plane_sweep" + suffix, p, blocks)
    return 0


def photometric(target_suffix: str, run: Run, suffix: str, p: Fields) -> int:
    """``target_suffix``: "_u8" for a target of bytes, or ""."""
    channels, width, height = p["n"], p["width"], p["height"]
    image, target, grad = p["image"], p["target"], p["grad"]
    tiles = -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT[suffix])  # of a channel
    device, dtype = image.device, image.dtype
    sums = torch.empty(channels * tiles, 3, dtype=torch.float64, device=device)
    values = channels * width * height
    at_once = channels
    if grad is not None:
        size = 3 * width * height * image.element_size()
        at_once = max(1, min(channels, _MAPS_BYTES // size))
        maps = torch.empty(at_once * 3 * width * height, dtype=dtype, device=device)
    for first in range(0, channels, at_once):
        last = min(first + at_once, channels)
        blocks = (last - first) * tiles
        inputs = {
            "n": last - first,
            "width": width,
            "height": height,
            "image": image[first:last],
            "target": target[first:last],
            "maps": None if grad is None else maps,
        }
        similarity = {**inputs, "sums": sums[first * tiles :]}
        run(f"photometric_similarity{target_suffix}{suffix}", similarity, blocks)
        if grad is not None:
            names = ("l1_weight", "ssim_weight", "huber_weight")
            weights = {name: p[name] / values for name in names}
            gradient = {**inputs, **weights, "grad": grad[first:last]}
            run(f"photometric_gradient{target_suffix}{suffix}", gradient, blocks)
    means = {"n": channels * tiles, "sums": sums, "values": values, "means": p["means"]}
    run("photometric_means", means, 1)
    return 0


def neighbours(run: Run, suffix: str, p: Fields) -> int:
    n, points = p["n"], p["points"]
    if n == 0:
        return 0

    def empty(*shape: int, dtype: torch.dtype = points.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=points.device)

    low, high = torch.aminmax(points, dim=0)
    codes, order = empty(n, dtype=torch.int64), empty(n, dtype=torch.int32)
    chunks = -(-n // _CHUNK)
    groups = -(-chunks // _CHUNK)
    ordered, chunk_boxes, group_boxes = empty(n, 3), empty(chunks, 8), empty(groups, 8)
    run(
        "neighbours_codes" + suffix,
        {"n": n, "points": points, "low": low, "high": high, "codes": codes},
    )
    others = torch.empty_like(codes), torch.empty_like(order)
    _, order = sort_pairs(run, n, codes, others[0], order, others[1], (0, _CODE_BITS), rows=True)
    run(
        "neighbours_chunks" + suffix,
        {"n": n, "points": points, "order": order, "ordered": ordered, "boxes": chunk_boxes},
    )
    run(
        "neighbours_groups" + suffix,
        {"n": chunks, "chunk_boxes": chunk_boxes, "boxes": group_boxes},
    )
    search = f"neighbours_of_{next(size for size in NEIGHBOUR_LISTS if size >= p['k'])}"
    boxes = {"chunk_boxes": chunk_boxes, "group_boxes": group_boxes}
    run(search + suffix, {**p, "points": ordered, "order": order, **boxes})
    return 0


#: The functions that are not one kernel. `suffix` is "" or "_f64": that of the kernels that exist
#: in both variants.
SEQUENCES: dict[str, Callable[[Run, str, Fields], int]] = {
    "project_cull": _project_cull,
    "project_pose_blocks": lambda run, suffix, p: min(p["n"], 1),
    "project_bwd": _project_bwd,
    "adam_step": _adam_step,
    "splat_record_bytes": lambda run, suffix, p: 0,  # the GPU reads the packed rows
    "splats_recolor": lambda run, suffix, p: 0,
    "splats_sort": splats_sort,
    "tiles_parts": lambda run, suffix, p: 0,
    "tiles_workspace_bytes": workspace_bytes,
    "tiles_count": tiles_count,
    "tiles_fill": tiles_fill,
    "rasterize_block_bytes": lambda run, suffix, p: 1,  # a bit for each of the 8 warps of a tile
    "rasterize_has_slots": _has_slots,
    "rasterize_boundaries": lambda run, suffix, p: _boundaries(p["n"]),
    "rasterize_bwd": _rasterize_bwd,
    "photometric": partial(photometric, ""),
    "photometric_u8": partial(photometric, "_u8"),
    "neighbours": neighbours,
    "plane_sweep": _plane_sweep,
}
