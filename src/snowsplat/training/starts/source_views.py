"""The views of a dataset that get a depth map, and the source views that check it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.depth_map import LONGER_SIDE
from snowsplat.training.starts.photos import in_threads
from snowsplat.util.image_size import scaled_size

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
#: Angles between two viewing directions of a point, in degrees. The weight of a pair of views rises
#: from 0 at the first angle to 1 at the second one, and falls from 1 at the third to 0 at the last.
#: With a smaller angle, the depth is uncertain; with a larger one, the pictures differ too much.
_ANGLES = (1.0, 6.0, 15.0, 40.0)
#: A source view needs this share of the weight of the best one.
_LEAST_WEIGHT = 0.1


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

    ``longer_side``: of a map, in pixels.
    """
    cameras = [view.camera for view in dataset.train]
    sizes = [scaled_size(camera.width, camera.height, longer_side) for camera in cameras]
    pixels = sum(map(math.prod, sizes))
    limit = min(_MAX_PIXELS, images.budget_bytes // _BYTES_PER_PIXEL)
    views = dataset.train[:: math.ceil(pixels / max(limit, 1))]
    points = _points(dataset, generator)
    sample = points[torch.randperm(len(points), generator=generator)[:_SAMPLE]]
    own = [view.camera for view in views]
    return MapViews(views, source_views(own, sample.to(images.device), _SOURCES), points)


def map_pixels(views: int, width: int, height: int, longer_side: int = LONGER_SIDE) -> int:
    """About the number of pixels of all depth maps for this number of views of this size."""
    return min(_MAX_PIXELS, views * math.prod(scaled_size(width, height, longer_side)))


def _points(dataset: Dataset, generator: torch.Generator) -> Tensor:
    if dataset.points is not None:
        return dataset.points.xyz.cpu()
    low, high = dataset.bounds
    return low + (high - low) * torch.rand(4 * _SAMPLE, 3, generator=generator)


def source_views(cameras: Sequence[Camera], points: Tensor, count: int) -> list[list[int]]:
    """For each view, the views that show the same points from suitable directions.

    The weight of a pair of views is the sum, over the points that are visible in both, of a weight
    for the angle between the two viewing directions, as in the view selection of MVSNet (Yao et al.
    2018), multiplied by the ratio of the two depths.

    Args:
        points: (P, 3) in the world frame, a sample of the scene; computed on its device. Occlusion
            is not considered.
        count: the maximum number of source views of a view.

    Returns: Indices into ``cameras``, the best one first. The list of a view is empty if no other
    view shows the same points.
    """
    points = points.to(torch.float64)
    visible, depths, rays = [], [], []
    for camera in cameras:
        depth, inside = camera.sees(points)
        visible.append(inside)
        depths.append(depth.clamp(min=1e-12))
        rays.append(torch.nn.functional.normalize(points - camera.position.to(points), dim=1))
    visible_, depth_, ray_ = torch.stack(visible), torch.stack(depths), torch.stack(rays)

    def chosen(i: int) -> list[int]:
        cosine = (ray_ * ray_[i]).sum(2).clamp(-1.0, 1.0)
        ratio = torch.minimum(depth_ / depth_[i], depth_[i] / depth_)
        weight = (_angle_weight(cosine.acos()) * ratio * (visible_ & visible_[i])).sum(1)
        weight[i] = 0.0
        best = torch.argsort(weight, descending=True, stable=True)[:count]
        weights = weight[best].tolist()
        least = max(_LEAST_WEIGHT * weights[0], 1e-9)
        return [j for j, w in zip(best.tolist(), weights, strict=True) if w >= least]

    return in_threads(chosen, range(len(cameras)), points.device)


def _angle_weight(angle: Tensor) -> Tensor:
    a, b, c, d = (math.radians(degrees) for degrees in _ANGLES)
    return torch.minimum((angle - a) / (b - a), (d - angle) / (d - c)).clamp(0.0, 1.0)
