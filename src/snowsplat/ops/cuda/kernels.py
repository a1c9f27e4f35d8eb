"""`Kernel`: the data needed to launch a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from snowsplat.util.native_layout import Params


@dataclass(frozen=True)
class Kernel:
    """A kernel in `native/cuda/<file>.cu`; its variant for float64 has the suffix `_f64`.

    params: its struct of parameters.
    threads: number of threads of a block, as in the SNOW_KERNEL macro.
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
    """Queues a kernel. ``name``: its full name; ``blocks``: 0 queues nothing."""

    def __call__(self, name: str, blocks: int, params: Params) -> None: ...
