"""`Kernel`: the data needed to launch a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from snowsplat.ops.layout import Params


@dataclass(frozen=True)
class Kernel:
    """A kernel in `native/cuda/<file>.cu`; the one for float64 has the suffix `_f64`.

    params: its struct of parameters.
    threads: number of threads of a block, as in its SNOW_KERNEL.
    items: number of items that a block processes.
    """

    file: str
    params: type[Params]
    threads: int
    items: int

    def blocks(self, n: int) -> int:
        """The number of blocks for n items."""
        return -(-n // self.items)


class Run(Protocol):
    """Queues a kernel behind those before it: its full name, blocks (0: none), parameters."""

    def __call__(self, name: str, blocks: int, params: Params) -> None: ...
