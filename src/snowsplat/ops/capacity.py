"""`Room`: memory set aside on a GPU before it is known how much will be needed."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class Room:
    """Room for the instances of a frame: the pairs of a splat and a tile that it touches.

    Blending has to know their number, and the CPU would have to wait for a GPU to count them. With
    a Room it sets memory aside for `instances` of them and goes on; the GPU writes what it needed
    into `needed`, (1,) int64. Where that is more, image and gradients are those of a part of the
    splats: the frame has to be made again with more room. On the CPU there is always enough.
    """

    instances: int
    needed: Tensor
