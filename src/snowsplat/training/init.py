"""The Gaussians that a training begins with."""

from __future__ import annotations

import math

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.training.config import TrainConfig
from snowsplat.training.finite import check_finite


def first_scene(
    dataset: Dataset, config: TrainConfig, generator: torch.Generator, device: torch.device
) -> Gaussians:
    """One Gaussian a point: those of the dataset, or random ones; no more than the cap.

    Raises:
        UserError: points that are so far apart that single precision has no Gaussians for them.
    """
    points = dataset.points
    cap = config.density.max_gaussians or math.inf
    if points is None:
        count = int(min(config.initial_points, cap))
        gaussians = Gaussians.random_in_bounds(
            dataset.bounds, count, generator, config.sh_degree, config.initial_opacity
        )
    else:
        if len(points) > cap:
            chosen = torch.randperm(len(points), generator=generator)[: int(cap)]
            points = Points(points.xyz[chosen], points.rgb[chosen])
        points = points.to(device)
        gaussians = Gaussians.from_points(points, config.sh_degree, config.initial_opacity)
    gaussians = gaussians.to(device)
    gaussians.log_scales += math.log(config.initial_scale)
    check_finite(
        "what the points of the dataset make",
        gaussians.parameters(),
        "remove the points that are absurdly far from the others",
    )
    return gaussians.select(morton_order(gaussians.means))
