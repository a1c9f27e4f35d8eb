"""The views of a dataset that get a depth map, and the source views that check it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.training.starts.depth_map import LONGER_SIDE, map_size
from snowsplat.training.starts.source_views import source_views

#: Number of source views of each depth map.
_SOURCES = 4
#: Number of points with which the source views are chosen.
_SAMPLE = 1000
#: The maximum number of pixels of all depth maps. If there are more, one view in two, in three … is
#: used: the photos of a large dataset overlap more, and this limits time and memory.
_MAX_PIXELS = 16_000_000
#: Depth maps may have one pixel per this number of bytes of the memory for photos: 4 for the depth,
#: 5 for the brightness, and masks.
_BYTES_PER_PIXEL = 12


@dataclass(frozen=True)
class MapViews:
    """The result of `choose_views`.

    Attributes:
        views: training views.
        sources: for each view, indices into ``views``, the best one first; see `source_views`.
        points: (P, 3) in the world frame, on the CPU: those of the dataset; without points, random
            ones within its bounds.
    """

    views: list[View]
    sources: list[list[int]]
    points: Tensor


def choose_views(
    dataset: Dataset,
    images: Photos,
    generator: torch.Generator,
    longer_side: int = LONGER_SIDE,
) -> MapViews:
    """Choose the views that get a depth map: all training views, if memory permits.

    ``longer_side``: see `map_size`.
    """
    cameras = [view.camera for view in dataset.train]
    sizes = [map_size(camera.width, camera.height, longer_side) for camera in cameras]
    pixels = sum(map(math.prod, sizes))
    limit = min(_MAX_PIXELS, images.budget_bytes // _BYTES_PER_PIXEL)
    views = dataset.train[:: math.ceil(pixels / max(limit, 1))]
    points = _points(dataset, generator)
    sample = points[torch.randperm(len(points), generator=generator)[:_SAMPLE]]
    own = [view.camera for view in views]
    return MapViews(views, source_views(own, sample.to(images.device), _SOURCES), points)


def map_pixels(views: int, width: int, height: int, longer_side: int = LONGER_SIDE) -> int:
    """About the number of pixels of all depth maps for this number of views of this size."""
    return min(_MAX_PIXELS, views * math.prod(map_size(width, height, longer_side)))


def _points(dataset: Dataset, generator: torch.Generator) -> Tensor:
    if dataset.points is not None:
        return dataset.points.xyz.cpu()
    low, high = dataset.bounds
    return low + (high - low) * torch.rand(4 * _SAMPLE, 3, generator=generator)
