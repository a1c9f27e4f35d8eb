"""`swept_points`: points on the surfaces, from depth maps that a plane sweep computes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.image_loader import ImageLoader
from snowsplat.training.starts.depth_maps import depth_maps, map_size, photo_for_map
from snowsplat.training.starts.fusion import consistent, thinned, world_points
from snowsplat.training.starts.source_views import source_views

#: Number of source views of each depth map.
_SOURCES = 4
#: Number of points with which the source views are chosen.
_SAMPLE = 1000
#: This number of pixels per resulting point is used.
_PIXELS_PER_POINT = 16
#: The maximum number of pixels of all depth maps. If there are more, one view in two, in three … is
#: used: the photos of a large dataset overlap more, and this limits time and memory.
_MAX_PIXELS = 16_000_000
#: Depth maps may have one pixel per this number of bytes of the memory for photos.
_BYTES_PER_PIXEL = 10


def swept_points(
    dataset: Dataset, images: ImageLoader, count: int, generator: torch.Generator
) -> Points:
    """At most ``count`` points on the surfaces that several photos show, in the world frame, on the
    CPU.

    The depth maps of the training views are computed by plane sweep. The map of each view is
    checked with those of its source views; see `depth_maps` and `fusion`.

    Args:
        generator: a random generator on the CPU.
    """
    views = _used_views(dataset, images)
    samples = _samples(dataset, generator)
    chosen = torch.randperm(len(samples), generator=generator)[:_SAMPLE]
    cameras = [view.camera for view in views]
    sources = source_views(cameras, samples[chosen], _SOURCES)
    maps = depth_maps(views, sources, images, samples)
    confirmed = consistent(maps, sources)
    share = _PIXELS_PER_POINT * count / max(1, sum(int(pixels.sum()) for pixels in confirmed))
    points, widths = [torch.zeros(0, 3)], [torch.zeros(0)]
    colors = [torch.zeros(0, 3, dtype=torch.uint8)]
    for view, depth_map, pixels in zip(views, maps, confirmed, strict=True):
        if depth_map is None:
            continue
        pixels &= torch.rand(pixels.shape, generator=generator) < share
        points.append(world_points(depth_map, pixels))
        colors.append(photo_for_map(view, images).rgb[pixels])
        widths.append(1.0 / (depth_map.inverse_depth[pixels] * depth_map.camera.fx))
    return thinned(torch.cat(points), torch.cat(colors), torch.cat(widths), count)


def map_pixels(views: int, width: int, height: int) -> int:
    """About the number of pixels of all depth maps that `swept_points` computes for this number of
    views of this size.
    """
    return min(_MAX_PIXELS, views * math.prod(map_size(width, height)))


def _used_views(dataset: Dataset, images: ImageLoader) -> list[View]:
    cameras = [view.camera for view in dataset.train]
    pixels = sum(math.prod(map_size(camera.width, camera.height)) for camera in cameras)
    limit = min(_MAX_PIXELS, images.budget_bytes // _BYTES_PER_PIXEL)
    return dataset.train[:: math.ceil(pixels / max(limit, 1))]


def _samples(dataset: Dataset, generator: torch.Generator) -> Tensor:
    """The points of the dataset; without points, random ones within its bounds."""
    if dataset.points is not None:
        return dataset.points.xyz.cpu()
    low, high = dataset.bounds
    return low + (high - low) * torch.rand(4 * _SAMPLE, 3, generator=generator)
