"""`neighbours`: distances to the nearest other points."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_tensor, variant
from snowsplat.ops.native import launch

_MOST = 64


def neighbours(points: Tensor, k: int = 3) -> Tensor:
    """Distances (N, k), ascending, from each of points (N, 3) to its k nearest others, exactly.

    A point at the same place is another (distance 0). Where there are fewer than k others: inf.
    Float32 or float64, in the units of the points. Not differentiable.

    Raises ValueError for a wrong shape or dtype, k outside 1 … 64, or points that are not finite.
    """
    check_float("neighbours", "points", points)
    check_tensor("neighbours", "points", points, (None, 3), points)
    if not 1 <= k <= _MOST:
        raise ValueError(f"neighbours: k must be 1 to {_MOST}, got {k}")
    points = points.detach().contiguous()
    bad = int((~torch.isfinite(points)).any(dim=1).sum())
    if bad:
        raise ValueError(f"neighbours: {bad} of {len(points)} points are not finite")
    distances = points.new_empty(len(points), k)
    launch(variant("neighbours", points), len(points), points, k, distances)
    return distances
