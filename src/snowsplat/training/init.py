"""`initial_gaussians`: initialisation, from points of the dataset, depth maps, or at random."""

from __future__ import annotations

import math

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.image_loader import ImageLoader
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.training.config import TrainConfig
from snowsplat.training.dense_init import dense_points
from snowsplat.training.finite import check_finite
from snowsplat.util.errors import SettingError


def initial_count(dataset: Dataset, config: TrainConfig) -> int:
    """The maximum number of Gaussians that `initial_gaussians` returns."""
    limit = config.density.max_gaussians
    dense = round(config.dense_init * limit)
    if dataset.points is not None:
        count = len(dataset.points) + dense
    else:
        count = dense or config.initial_points
    return min(count, limit or count)


def initial_gaussians(
    dataset: Dataset,
    config: TrainConfig,
    images: ImageLoader,
    generator: torch.Generator,
    device: torch.device,
) -> Gaussians:
    """One Gaussian per point of the dataset, or random Gaussians if there are no points.

    If ``config.dense_init`` is positive, the points of `dense_points` are added to those of the
    dataset. There are at most ``density.max_gaussians``. As in section 5.1 of the paper, they are
    isotropic. The scale is the mean distance to the three nearest neighbours times
    ``config.initial_scale``; the colour is that of the point; the opacity is
    ``config.initial_opacity``. The rows are in Morton order.

    Args:
        images: the photos of the dataset, for `dense_points`.
        generator: a random generator on the CPU. It draws the random points; if the dataset has too
            many points, it selects those that are used.

    Raises:
        UserError: some points are so far apart that single precision cannot represent their
            Gaussians.
        SettingError: ``dense_init`` is set, but the number of Gaussians has no limit.
    """
    limit = config.density.max_gaussians or math.inf
    points = dataset.points
    if config.dense_init > 0.0:
        if limit == math.inf:
            raise SettingError(
                "dense_init", "is a share of the limit of Gaussians; set max_gaussians as well"
            )
        dense = dense_points(dataset, images, round(config.dense_init * limit), generator)
        points = _joined(points, dense)
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


def _joined(points: Points | None, dense: Points) -> Points | None:
    if points is None:
        return dense if len(dense) else None
    return Points(
        torch.cat([points.xyz, dense.xyz.to(points.xyz.device)]),
        torch.cat([points.rgb, dense.rgb.to(points.rgb.device)]),
    )
