"""`project` and the statistics of its splats on a GPU."""

from __future__ import annotations

from collections.abc import Callable

from snowsplat.ops.cuda.kernels import Kernel

KERNELS: dict[str, Kernel] = {
    "accumulate_screen_statistics": Kernel("statistic", threads=256, items=256),
}

SEQUENCES: dict[str, Callable[..., int]] = {}
