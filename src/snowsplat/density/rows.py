"""Which rows of a set of Gaussians are sound, and in what order to keep them in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.gaussians import Gaussians

#: Bits an axis: three axes fill 63 bits of an int64. So fine a grid survives stray Gaussians: with
#: one at a thousand times the scene's size, two thousand cells an axis remain for the scene.
BITS = 21


def finite_rows(gaussians: Gaussians) -> Tensor:
    """(N,) bool: Gaussians all of whose parameters are finite."""
    finite = torch.ones(len(gaussians), dtype=torch.bool)
    for parameter in gaussians.parameters().values():
        finite &= parameter.reshape(len(gaussians), -1).isfinite().all(dim=1)
    return finite


def morton_order(points: Tensor) -> Tensor:
    """(N,) int64: the permutation that sorts finite ``points`` (N, 3) along a Morton (Z-order)
    curve.

    Neighbours in space become neighbours in memory, so that a view sees runs of rows, which is kind
    to the caches in projection and in the optimiser step (8% of a whole iteration at 200,000
    Gaussians). Equal codes keep their order: the result is a function of the points alone.
    """
    if len(points) == 0:
        return torch.empty(0, dtype=torch.int64)
    low = points.amin(dim=0).double()
    size = (points.amax(dim=0).double() - low).max().clamp_min(torch.finfo(torch.float64).tiny)
    cells = ((points.double() - low) / size * (2**BITS - 1)).long()
    x, y, z = _spread(cells).unbind(dim=1)
    return torch.argsort(x | y << 1 | z << 2, stable=True)


def _spread(values: Tensor) -> Tensor:
    """Move bit i of 21-bit integers to bit 3i, halving the groups of bits that stay together."""
    masks = (0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3)
    for shift, mask in zip((32, 16, 8, 4), masks, strict=True):
        values = (values | values << shift) & mask
    return (values | values << 2) & 0x1249249249249249
