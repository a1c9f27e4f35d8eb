"""Where the first Gaussians come from: the points of `STARTS`, one module for each.

A start returns points; `initial_gaussians` makes one Gaussian of each. To add one, write a function
and add it to `STARTS`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.image_loader import Photos
from snowsplat.training.starts.carve import carved_points
from snowsplat.training.starts.depth import depth_points
from snowsplat.training.starts.map_views import map_pixels
from snowsplat.training.starts.random_rays import random_points
from snowsplat.training.starts.sweep import swept_points

__all__ = [
    "STARTS",
    "Start",
    "carved_points",
    "depth_points",
    "map_pixels",
    "random_points",
    "swept_points",
]

#: dataset, its photos, maximum number of points, random generator on the CPU -> points in the world
#: frame, on the CPU; there may be none.
Start = Callable[[Dataset, Photos, int, torch.Generator], Points]


def _dataset_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """All points of the dataset: those of structure from motion."""
    if dataset.points is None:
        return Points(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    return dataset.points.to(torch.device("cpu"))


STARTS: dict[str, Start] = {
    "points": _dataset_points,
    "random": random_points,
    "carve": carved_points,
    "depth": depth_points,
    "sweep": swept_points,
}
