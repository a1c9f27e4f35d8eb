"""`points_in_frusta` on a GPU."""

from __future__ import annotations

from collections.abc import Callable

from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.params import PointsInFrustaParams

KERNELS: dict[str, Kernel] = {
    "points_in_frusta": Kernel("frusta", PointsInFrustaParams, threads=128, items=128),
}
SEQUENCES: dict[str, Callable[..., int]] = {}
