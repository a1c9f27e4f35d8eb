"""blending on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {
    "blend_fwd": Kernel("blend", threads=256, items=1),
    "blend_count": Kernel("blend", threads=256, items=1),
    "blend_bwd": Kernel("blend", threads=256, items=1),
    "background_bwd": Kernel("blend", threads=128, items=1),
}


def _sums_in_order(run: Run, suffix: str, n: int) -> int:
    """Sums in a fixed order cost memory and time, so those who want them ask torch for them."""
    return int(torch.are_deterministic_algorithms_enabled())


def _block_bytes(run: Run, suffix: str, n: int) -> int:
    """A bit for each of the eight warps of a tile."""
    return 1


SEQUENCES: dict[str, Callable[..., int]] = {
    "blend_block_bytes": _block_bytes,
    "blend_sums_in_order": _sums_in_order,
}
