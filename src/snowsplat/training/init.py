"""`initial_gaussians`: initialisation, from the points of the dataset or at random."""

from __future__ import annotations

import math

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.training.config import TrainConfig
from snowsplat.training.finite import check_finite


def initial_gaussians(
    dataset: Dataset, config: TrainConfig, generator: torch.Generator, device: torch.device
) -> Gaussians:
    """One Gaussian per point of the dataset, or random Gaussians if it has no points.

    There are at most ``density.max_gaussians``. As in section 5.1 of the paper, they are isotropic.
    The scale is the mean distance to the three nearest neighbours times ``config.initial_scale``;
    the colour is that of the point; the opacity is ``config.initial_opacity``. The rows are in
    Morton order.

    Args:
        generator: a random generator on the CPU. It draws the random points; if the dataset has too
            many points, it selects those that are used.

    Raises:
        UserError: some points are so far apart that single precision cannot represent their
            Gaussians.
    """
    points = dataset.points
    limit = config.density.max_gaussians or math.inf
    if points is None:
        count = int(min(config.initial_points, limit))
        gaussians = Gaussians.random_in_bounds(
            dataset.bounds, count, generator, config.sh_degree, config.initial_opacity
        )
    else:
        if len(points) > limit:
            chosen = torch.randperm(len(points), generator=generator)[: int(limit)]
            points = Points(points.xyz[chosen], points.rgb[chosen])
        points = points.to(device)
        gaussians = Gaussians.from_points(points, config.sh_degree, config.initial_opacity)
    gaussians = gaussians.to(device)
    gaussians.log_scales += math.log(config.initial_scale)
    check_finite(
        "the points of the dataset",
        gaussians.parameters(),
        "remove points that are extremely far from the others",
    )
    return gaussians.select(morton_order(gaussians.means))
