"""Rasterization on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.params import (
    BackgroundBackwardParams,
    RasterizeBackwardParams,
    RasterizeCountParams,
    RasterizeForwardParams,
    SizeQueryParams,
)

KERNELS: dict[str, Kernel] = {
    "rasterize_fwd": Kernel("rasterize", RasterizeForwardParams, threads=256, items=1),
    "rasterize_median": Kernel("rasterize", RasterizeForwardParams, threads=256, items=1),
    "rasterize_count": Kernel("rasterize", RasterizeCountParams, threads=256, items=1),
    "rasterize_bwd": Kernel("rasterize", RasterizeBackwardParams, threads=256, items=1),
    "background_bwd": Kernel("rasterize", BackgroundBackwardParams, threads=128, items=1),
}


def _has_slots(run: Run, suffix: str, query: SizeQueryParams) -> int:
    """Sums in a fixed order need memory and time, so they are used only if torch is set to it."""
    return int(torch.are_deterministic_algorithms_enabled())


def _block_bytes(run: Run, suffix: str, query: SizeQueryParams) -> int:
    """One byte per instance: one bit for each of the eight warps of a tile."""
    return 1


SEQUENCES: dict[str, Callable[..., int]] = {
    "rasterize_block_bytes": _block_bytes,
    "rasterize_has_slots": _has_slots,
}
