"""`confirm_by_photos`: the depth maps of a scene, corrected where photos confirm another depth.

A training makes images like the photos, and many arrangements of Gaussians do. On a wall with
little texture, they are in front of the wall, because those in front hide those behind. A plane
sweep compares the photos themselves: each pixel gets the depth at which a window of one photo
correlates best with others. Where the map of another photo has the same depth, this depth
replaces that of the Gaussians; where the two agree, their mean does, because their errors are not
the same. Elsewhere, for example on a wall of one colour, the depth of the Gaussians remains, and
has less weight.

Neighbouring Gaussians have about the same error: on an opaque object, what is behind the first ones
costs nothing, and the median lies behind the surface. So the mean difference of the two depths
around a pixel is first subtracted from the depth of the Gaussians, confirmed or not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, interpolate

from snowsplat.data import ImageLoader, View
from snowsplat.surface.depth import DepthMap
from snowsplat.surface.volume import Report
from snowsplat.training.starts.depth_map import LONGER_SIDE, map_size
from snowsplat.training.starts.fusion import confirmed_pixels
from snowsplat.training.starts.photos import decoded_ahead
from snowsplat.training.starts.plane_sweep import Picture, depth_ranges, swept_maps
from snowsplat.training.starts.source_views import source_views
from snowsplat.util.process_memory import return_unused

#: All maps of a sweep together have at most this number of pixels, of nine bytes.
_MOST_PIXELS = 24_000_000
#: Each sweep has half the size of the one before, so larger windows: faint texture suffices.
_SWEEPS = 2
#: For photos that are decoded ahead; each is used once.
PHOTO_BYTES = 32 << 20
#: Each map is checked with those of this number of other views.
_SOURCES = 4
#: Points of the scene: with the first number, other views are chosen; with the second, the range
#: of the depths of a view.
_SAMPLE, _POINTS = 300, 10_000
#: The two depths agree if they differ by less than this share.
_AGREE = 0.03
#: The mean difference is that of 3×3 cells, each this share of the longer side of the map; the two
#: depths agree in at least the second share of the pixels there.
_CELL, _FEWEST = 1 / 40, 0.05
#: Of 255: the least weight of a depth that photos confirm.
_CONFIRMED = 128
#: The factor of the weight of all others.
_UNCONFIRMED = 0.25
#: The depths of two neighbouring pixels are those of one surface if an interpolated depth differs
#: by less than this share from the nearest one.
_SMOOTH = 0.01


def confirm_by_photos(
    views: Sequence[View], maps: Sequence[DepthMap], far: float, report: Report
) -> None:
    """Corrects maps, in place, by the depths that two photos confirm.

    Pixels that show no surface, and views that share no surface with others, remain as they are.

    Args:
        maps: of each view.
        far: farther away, in world units, there is no surface.

    Raises:
        UserError: a photo is damaged.
    """
    points = _points_of(maps)
    sample = points[:: math.ceil(max(1, len(points)) / _SAMPLE)]
    sources = source_views([view.camera for view in views], sample, _SOURCES)
    ranges = depth_ranges(views, points)
    pictures = _pictures(views, report)
    return_unused()
    found: list[Tensor | None] = [None] * len(maps)  # (h, w) inverse depths; 0: not confirmed
    for number in range(_SWEEPS):
        report(number, _SWEEPS, "comparisons of photos")
        swept = swept_maps(pictures, ranges, sources)
        for i, known in enumerate(confirmed_pixels(swept, sources, points.device)):
            each, finer = swept[i], found[i]
            if each is not None:
                inverse = each.inverse_depth.masked_fill_(~known, 0.0)  # not used again
                if finer is not None:
                    inverse = torch.where(finer > 0, finer, _enlarged(inverse, finer.shape))
                found[i] = inverse
        del swept
        pictures = [picture.half for picture in pictures]
    for i, inverse_depth in enumerate(found):
        if inverse_depth is not None:
            _correct(maps[i], inverse_depth, far)


def _pictures(views: Sequence[View], report: Report) -> list[Picture]:
    """The photos at the size of the first sweep."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    side = min(LONGER_SIDE, max(1, int(longest * min(1.0, math.sqrt(_MOST_PIXELS / pixels)))))
    widths = [map_size(view.camera.width, view.camera.height, side)[0] for view in views]
    found = []
    with ImageLoader(views, budget_bytes=PHOTO_BYTES) as loader:
        for i, view in enumerate(decoded_ahead(views, widths, loader)):
            report(i, len(views), "photos")
            found.append(Picture.from_view(view, loader, side))
    return found


def _points_of(maps: Sequence[DepthMap]) -> Tensor:
    """(P, 3) float64 on the CPU, world frame: points on the surfaces of all maps."""
    random = torch.Generator().manual_seed(0)
    count, found = math.ceil(_POINTS / len(maps)), []
    for each in maps:
        height, width = each.depth.shape
        rows, columns = (
            torch.randint(size, (count,), generator=random) for size in (height, width)
        )
        z = each.depth.cpu()[rows, columns].double()
        x = (columns + 0.5 - each.camera.cx) / each.camera.fx
        y = (rows + 0.5 - each.camera.cy) / each.camera.fy
        pose = each.camera.world_from_cam.cpu().double()
        points = (torch.stack([x, y, torch.ones_like(x)], 1) * z[:, None]) @ pose[:, :3].T
        found.append((points + pose[:, 3])[z.isfinite() & (z > 0)])
    return torch.cat(found)


def _correct(each: DepthMap, inverse: Tensor, far: float) -> None:
    """Corrects a map by the confirmed inverse depths (h, w); 0: not confirmed."""
    inverse = _enlarged(inverse, each.depth.shape).to(each.depth.device)
    surface = each.depth.isfinite()
    known = surface & (inverse * far > 1.0)
    swept = 1.0 / inverse
    agree = (each.depth / swept - 1.0).abs() < _AGREE
    own = each.depth * torch.exp(-_difference(each.depth, swept, known & agree))
    swept = torch.where(agree, 0.5 * (swept + own), swept)
    doubtful = (_UNCONFIRMED * each.weight).ceil().to(torch.uint8)
    weight = torch.where(surface, doubtful, each.weight)
    each.weight.copy_(torch.where(known, each.weight.clamp(min=_CONFIRMED), weight))
    each.depth.copy_(torch.where(known, swept, own))


def _difference(depth: Tensor, swept: Tensor, agree: Tensor) -> Tensor:
    """(H, W): the logarithm of depth / swept, mean of the pixels around that agree; 0: too few."""
    ratio = torch.where(agree, (depth / swept).log(), 0.0)
    height, width = depth.shape
    cell = max(1, round(_CELL * max(height, width)))
    grid = math.ceil(height / cell), math.ceil(width / cell)
    shares = adaptive_avg_pool2d(torch.stack([agree.to(ratio), ratio])[None], grid)
    share, total = avg_pool2d(shares, 3, stride=1, padding=1)[0]
    mean = torch.where(share >= _FEWEST, total / share, 0.0)
    return interpolate(mean[None, None], list(depth.shape), mode="bilinear")[0, 0]


def _enlarged(inverse: Tensor, size: Sequence[int]) -> Tensor:
    """(h, w) at another size; 0 at the edges of surfaces, and where the values are 0."""
    if inverse.shape == size:
        return inverse
    known = torch.where(inverse > 0, inverse, torch.nan)[None, None]
    smooth = interpolate(known, list(size), mode="bilinear")[0, 0]
    nearest = interpolate(known, list(size), mode="nearest-exact")[0, 0]
    return torch.where((smooth / nearest - 1.0).abs() < _SMOOTH, smooth, 0.0)
