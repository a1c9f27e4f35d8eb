"""`swept_points`: points on the surfaces, from depth maps that a plane sweep computes."""

from __future__ import annotations

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.image_loader import Photos
from snowsplat.training.starts.depth_map import LONGER_SIDE
from snowsplat.training.starts.fusion import fused_points
from snowsplat.training.starts.map_views import choose_views
from snowsplat.training.starts.plane_sweep import depth_maps


def swept_points(
    dataset: Dataset,
    images: Photos,
    count: int,
    generator: torch.Generator,
    longer_side: int = LONGER_SIDE,
) -> Points:
    """At most ``count`` points on the surfaces that several photos show, in the world frame, on the
    CPU.

    The depth maps of the training views are computed by plane sweep. The map of each view is
    checked with those of its source views; see `depth_maps` and `fused_points`.

    Args:
        generator: a random generator on the CPU.
        longer_side: the maximum size of the maps, in pixels.
    """
    chosen = choose_views(dataset, images, generator, longer_side)
    maps = depth_maps(chosen.views, chosen.sources, images, chosen.points, longer_side)
    return fused_points(chosen, maps, images, count, generator)
