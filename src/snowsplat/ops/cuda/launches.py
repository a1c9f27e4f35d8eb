"""The native functions on a GPU and their kernels.

Most native functions are one kernel with the same name and parameters; a few are a sequence of
kernels. Each module (`projection`, `tiling`, …) declares its own:

KERNELS    name → `Kernel`: its file, struct of parameters, and block size.
SEQUENCES  name → a function `(run, suffix, params) -> int` that runs several kernels. `suffix` is
           "" or "_f64": the suffix of the kernels that exist in both variants.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from snowsplat.ops.cuda import (
    adam,
    driver,
    frusta,
    fusion,
    nearest_neighbours,
    photometric,
    projection,
    rasterizer,
    sorting,
    sweep,
    tiling,
)
from snowsplat.ops.cuda.kernels import Kernel
from snowsplat.util.native_layout import Params

_PARTS = (
    projection,
    adam,
    sorting,
    tiling,
    rasterizer,
    photometric,
    nearest_neighbours,
    sweep,
    frusta,
    fusion,
)
KERNELS: dict[str, Kernel] = {n: k for part in _PARTS for n, k in part.KERNELS.items()}
SEQUENCES: dict[str, Callable[..., int]] = {
    name: sequence for part in _PARTS for name, sequence in part.SEQUENCES.items()
}

Execute = Callable[[Kernel, str, int, Params], None]
"""Runs a kernel. Arguments: the kernel, its full name, the number of blocks, the parameters."""


def launch(name: str, params: Params) -> int:
    """`native.launch` for tensors on a GPU: queues the kernels on torch's current stream.

    Raises: UserError: the GPU cannot be used; the message says why.
    """
    return launch_by(driver.run, name, params)


def launch_by(execute: Execute, name: str, params: Any) -> int:
    """As `launch`, with `execute` instead of the GPU's driver."""

    def run(kernel_name: str, blocks: int, kernel_params: Params) -> None:
        if blocks > 0:
            kernel = KERNELS[kernel_name.removesuffix("_f64")]
            execute(kernel, kernel_name, blocks, kernel_params)

    base = name.removesuffix("_f64")
    suffix = name[len(base) :]
    if base in SEQUENCES:
        return SEQUENCES[base](run, suffix, params)
    run(name, KERNELS[base].blocks(params.n), params)
    return 0
