"""`neighbours`: distances to the nearest other points."""

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.util.native_layout import MAX_NEIGHBOURS


def neighbours(points: Tensor, k: int = 3) -> Tensor:
    """Exact distances (N, k), ascending, from each of points (N, 3) to its k nearest other points.

    Another point with the same coordinates counts, with distance 0. If there are fewer than k other
    points, the remaining distances are inf. Points are float32 or float64; distances have their
    dtype and unit. Not differentiable.

    Raises ValueError for a wrong shape or dtype, k outside 1 … 64, or points that are not finite.
    """
    check_float("neighbours", "points", points)
    check_tensor("neighbours", "points", points, (None, 3), points)
    if not 1 <= k <= MAX_NEIGHBOURS:
        raise ValueError(f"neighbours: k must be 1 to {MAX_NEIGHBOURS}, got {k}")
    points = points.detach().contiguous()
    bad = int((~torch.isfinite(points)).any(dim=1).sum())
    if bad:
        raise ValueError(f"neighbours: {bad} of {len(points)} points are not finite")
    distances = points.new_empty(len(points), k)
    launch(
        variant("neighbours", points),
        n=len(points),
        points=points,
        k=k,
        distances=distances,
    )
    return distances
