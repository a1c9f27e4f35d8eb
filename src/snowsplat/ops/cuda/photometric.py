"""photometric on a GPU."""

from __future__ import annotations

from collections.abc import Callable

from snowsplat.ops.cuda.kernels import Kernel

KERNELS: dict[str, Kernel] = {}

SEQUENCES: dict[str, Callable[..., int]] = {}
