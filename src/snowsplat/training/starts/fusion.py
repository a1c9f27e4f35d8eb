"""Depth maps of several views become points: the maps check one another, and points that are close
to one another are merged.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.data.dataset import Points
from snowsplat.data.photos.image_loader import Photos
from snowsplat.training.starts.depth_map import DepthMap
from snowsplat.training.starts.photos import in_threads, reduced_photo
from snowsplat.training.starts.source_views import MapViews

#: Two inverse depths of one point agree if they differ by at most this share.
_TOLERANCE = 0.02
#: This number of pixels per resulting point is used.
_PIXELS_PER_POINT = 16
#: Number of steps in the search for the voxel size.
_BISECTIONS = 12


def fused_points(
    chosen: MapViews,
    maps: Sequence[DepthMap | None],
    images: Photos,
    count: int,
    generator: torch.Generator,
) -> Points:
    """At most ``count`` points: those of the `confirmed_pixels`, merged by `merge_points`.

    Args:
        maps: the depth map of each view, on the device of ``images``; None if it has none.
        generator: a random generator on the CPU.

    Returns: the points on the CPU.
    """
    device = images.device
    confirmed = confirmed_pixels(maps, chosen.sources, device)
    number = int(torch.stack([pixels.sum() for pixels in confirmed]).sum())
    share = _PIXELS_PER_POINT * count / max(1, number)
    used = [
        pixels & (torch.rand(pixels.shape, generator=generator) < share).to(device)
        for pixels in confirmed
    ]

    def points_of(i: int) -> tuple[Tensor, Tensor, Tensor]:
        depth_map, pixels = maps[i], used[i]
        if depth_map is None:
            none = torch.zeros(0, 3, device=device)
            return none, none.to(torch.uint8), none[:, 0]
        camera = depth_map.camera
        photo = reduced_photo(chosen.views[i], images, camera.width, camera.height)
        width = 1.0 / (depth_map.inverse_depth[pixels] * camera.fx)
        return depth_map.points(pixels), photo.rgb[pixels], width

    found = in_threads(points_of, range(len(maps)), device)
    points, colors, widths = (torch.cat(parts) for parts in zip(*found, strict=True))
    return merge_points(points, colors, widths, count).to(torch.device("cpu"))


def confirmed_pixels(
    maps: Sequence[DepthMap | None], sources: Sequence[Sequence[int]], device: torch.device
) -> list[Tensor]:
    """For each map, (H, W) bool: the pixels whose depth the map of a source view confirms.

    A depth is confirmed if its point, projected into the source view, has the depth of the map
    there (geometric consistency, Schönberger et al. 2016).

    ``device``: that of the maps and of the result.
    """

    def confirmed(i: int) -> Tensor:
        depth_map = maps[i]
        if depth_map is None:
            return torch.zeros(0, 0, dtype=torch.bool, device=device)
        known = depth_map.inverse_depth > 0.0
        points = depth_map.points(known)
        agrees = torch.zeros(len(points), dtype=torch.bool, device=device)
        for j in sources[i]:
            other = maps[j]
            if other is not None:
                agrees |= _agrees(points, other)
        return known.clone().masked_scatter_(known, agrees)

    return in_threads(confirmed, range(len(maps)), device)


def _agrees(points: Tensor, depth_map: DepthMap) -> Tensor:
    """(P,) bool: whether the depth of each point is that of the map at its pixel."""
    camera = depth_map.camera
    pixel, depth = camera.project(points)
    x, y = pixel.nan_to_num(-1.0).clamp(-1.0, 1e6).floor().to(torch.int64).unbind(1)
    inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    found = depth_map.inverse_depth[y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)]
    return inside & (found > 0) & ((found * depth - 1.0).abs() <= _TOLERANCE)


def merge_points(points: Tensor, colors: Tensor, widths: Tensor, count: int) -> Points:
    """At most ``count`` points that represent many points.

    Space is divided into voxels, whose side is a power of two near a multiple of the width of a
    pixel at the depth of the point. Each voxel that contains points becomes one point, with their
    mean position and colour. The multiple is chosen so that there are at most ``count`` voxels.

    Args:
        points: (P, 3) float32, in the world frame.
        colors: (P, 3) uint8.
        widths: (P,) float32, widths of a pixel at the depths of the points, in world units.
    """
    low, high = -2.0, 12.0  # binary logarithms of the multiple
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _voxels(points, widths, middle)[1] > count else (low, middle)
    voxel, n = _voxels(points, widths, high)
    return Points(_means(points, voxel, n), _means(colors, voxel, n).round().to(torch.uint8))


def _voxels(points: Tensor, widths: Tensor, multiple: float) -> tuple[Tensor, int]:
    """The voxel of each point, (P,) int64 in 0..n−1, and their number n.

    ``multiple``: binary logarithm of the side of a voxel in units of ``widths``.
    """
    level = (widths.log2() + multiple).floor()
    cell = (points / torch.exp2(level)[:, None]).floor().to(torch.int64)
    key = (level - level[:1]).to(torch.int64)  # so the order of the points depends on no unit
    for axis in range(3):  # a hash; voxels that share one are merged, which is rare
        key = key * 6364136223846793005 + cell[:, axis]
    unique, voxel = key.unique(return_inverse=True)
    return voxel, len(unique)


def _means(values: Tensor, group: Tensor, n: int) -> Tensor:
    """(n, C) float32: the means of the rows of each group, summed in the order of the rows."""
    totals = values.new_zeros(n, values.shape[1], dtype=torch.float64)
    totals.index_add_(0, group, values.to(torch.float64))
    return (totals / torch.bincount(group, minlength=n)[:, None]).to(torch.float32)
