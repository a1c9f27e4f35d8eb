"""`Kernel`: what launching one has to know of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

Argument = torch.Tensor | int | float | None


@dataclass(frozen=True)
class Kernel:
    """A kernel in `native/cuda/<file>.cu`; with the suffix `_f64`, its twin for float64.

    threads: of a block, as in its SNOW_KERNEL.
    items: how many of the n things to do a block does.
    """

    file: str
    threads: int
    items: int

    def blocks(self, n: int) -> int:
        """Blocks that do n things."""
        return -(-n // self.items)


class Run(Protocol):
    """Queues a kernel behind those before it: its full name, blocks (0: nothing), arguments."""

    def __call__(self, name: str, blocks: int, *args: Argument) -> None: ...
