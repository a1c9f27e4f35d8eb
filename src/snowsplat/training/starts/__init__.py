"""Where the first Gaussians come from, one module for each start.

A start returns points; `initial_gaussians` makes one Gaussian of each. Their names are in
`snowsplat.training.settings.starts`; `start_of` has the functions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.image_loader import Photos
from snowsplat.training.settings.starts import STARTS
from snowsplat.training.starts.depth import depth_points
from snowsplat.training.starts.plane_sweep import swept_points
from snowsplat.training.starts.random_rays import random_points
from snowsplat.training.starts.source_views import map_pixels

if TYPE_CHECKING:
    from snowsplat.training.settings.starts import Start

__all__ = [
    "dataset_points",
    "depth_points",
    "map_pixels",
    "random_points",
    "start_of",
    "swept_points",
]


def dataset_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """All points of the dataset: those of structure from motion."""
    if dataset.points is None:
        return Points(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    return dataset.points.to(torch.device("cpu"))


_OF_PACKAGE: dict[str, Start] = {
    "points": dataset_points,
    "random": random_points,
    "depth": depth_points,
    "sweep": swept_points,
}


def start_of(name: str) -> Start:
    """The start that is registered under this name, or that of the package."""
    return STARTS[name] or _OF_PACKAGE[name]
