"""The native functions on a GPU: which kernels each is made of.

Most are one kernel of the same name and arguments; a few are a sequence of them. Each part of the
engine (`projection`, `tiling`, …) says so of its own:

KERNELS    name → `Kernel`: the file it is in, its threads a block, how much of `n` a block does.
SEQUENCES  name → a function `(run, suffix, n, *args) -> int` that runs kernels one after the other;
           `suffix` is "" or "_f64", for those that come in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from snowsplat.ops.cuda import (
    adam,
    driver,
    nearest_neighbours,
    photometric,
    projection,
    rasterizer,
    sorting,
    tiling,
)
from snowsplat.ops.cuda.kernels import Argument, Kernel

_PARTS = (projection, adam, sorting, tiling, rasterizer, photometric, nearest_neighbours)
KERNELS: dict[str, Kernel] = {n: k for part in _PARTS for n, k in part.KERNELS.items()}
SEQUENCES: dict[str, Callable[..., int]] = {
    name: sequence for part in _PARTS for name, sequence in part.SEQUENCES.items()
}


def launch(name: str, n: int, args: Sequence[Argument]) -> int:
    """What `native.launch` does with tensors on a GPU: queues it on torch's current stream.

    Raises:
        UserError: the GPU cannot be used; the line says why.
    """
    return launch_by(driver.run, name, n, args)


def launch_by(
    execute: Callable[[Kernel, str, int, Sequence[Argument]], None],
    name: str,
    n: int,
    args: Sequence[Argument],
) -> int:
    """The same by `execute(kernel, its name, blocks, arguments)`: a GPU's driver, or a test."""

    def run(kernel_name: str, blocks: int, *arguments: Argument) -> None:
        if blocks > 0:
            kernel = KERNELS[kernel_name.removesuffix("_f64")]
            execute(kernel, kernel_name, blocks, arguments)

    base = name.removesuffix("_f64")
    suffix = name[len(base) :]
    if base in SEQUENCES:
        return SEQUENCES[base](run, suffix, n, *args)
    run(name, KERNELS[base].blocks(n), n, *args)
    return 0
