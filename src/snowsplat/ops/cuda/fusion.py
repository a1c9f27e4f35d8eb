"""`fuse_depth` on a GPU."""

from __future__ import annotations

from collections.abc import Callable

from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.ops.params import FuseDepthParams

KERNELS: dict[str, Kernel] = {
    "fuse_depth": Kernel("fusion", FuseDepthParams, threads=128, items=128),
}
SEQUENCES: dict[str, Callable[..., int]] = {}
