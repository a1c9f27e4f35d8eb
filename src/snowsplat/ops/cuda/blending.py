"""blending on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {}


def _sums_in_order(run: Run, suffix: str, n: int) -> int:
    """Sums in a fixed order cost memory and time, so those who want them ask torch for them."""
    return int(torch.are_deterministic_algorithms_enabled())


SEQUENCES: dict[str, Callable[..., int]] = {
    "blend_sums_in_order": _sums_in_order,
}
