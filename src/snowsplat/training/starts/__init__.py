"""Where the first Gaussians come from, one module for each start.

A start returns points; `initial_gaussians` makes one Gaussian of each. Their names are in
`snowsplat.training.settings.starts`.
"""

from __future__ import annotations

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.image_loader import Photos
from snowsplat.training.starts.depth import depth_points
from snowsplat.training.starts.map_views import map_pixels
from snowsplat.training.starts.random_rays import random_points
from snowsplat.training.starts.sweep import swept_points

__all__ = [
    "dataset_points",
    "depth_points",
    "map_pixels",
    "random_points",
    "swept_points",
]


def dataset_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """All points of the dataset: those of structure from motion."""
    if dataset.points is None:
        return Points(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    return dataset.points.to(torch.device("cpu"))
