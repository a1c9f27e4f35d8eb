"""`initial_gaussians`: the first Gaussians, from the points of one or more starts."""

import math
from collections.abc import Callable

import torch

from snowsplat.data.dataset import Dataset, Points
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.starts import start_of
from snowsplat.training.step.finite import check_finite
from snowsplat.util.messages import message

#: The sky has at most this share of the points of a start, a twentieth of the limit of Gaussians.
_SHARE_OF_SKY = 0.125


def most_sky_points(count: int) -> int:
    """The maximum number of points of the sky, for ``count`` points per start."""
    return math.ceil(_SHARE_OF_SKY * count)


def initial_count(dataset: Dataset, config: TrainConfig) -> int:
    """The maximum number of Gaussians that `initial_gaussians` returns."""
    limit = config.density.max_gaussians
    points = 0 if dataset.points is None else len(dataset.points)
    count = sum(points if name == "points" else config.points_per_start for name in config.starts)
    if config.sky:
        count += most_sky_points(config.points_per_start)
    return min(count or config.points_per_start, limit or count)


def starts_at_random(dataset: Dataset, config: TrainConfig) -> bool:
    """Whether most of the first Gaussians probably lie in empty space."""
    without = {"random"} if dataset.points is not None else {"random", "points"}
    return without.issuperset(config.starts)


def initial_gaussians(
    dataset: Dataset,
    config: TrainConfig,
    images: Photos,
    generator: torch.Generator,
    device: torch.device,
    adapted: Callable[[Points], Points] = lambda points: points,
) -> Gaussians:
    """One Gaussian for each point of the starts of ``config.init``.

    There are at most ``density.max_gaussians``. As in section 5.1 of the paper, they are isotropic.
    The scale is the mean distance to the three nearest neighbours times ``config.initial_scale``;
    the colour is that of the point; the opacity is ``config.initial_opacity``. The rows are in
    Morton order.

    Args:
        images: the photos of the dataset.
        generator: a random generator on the CPU. If there are too many points, it selects those
            that are used.
        adapted: changes the points of the starts; see `Part.points`.

    Raises:
        UserError: some points are so far apart that single precision cannot represent their
            Gaussians.
        SettingError: ``initial_points`` is a share, but the number of Gaussians has no limit.
    """
    points = _points_of(config.starts, dataset, config, images, generator)
    if not len(points):
        points = _points_of(("random",), dataset, config, images, generator)
    points = adapted(points)
    limit = config.density.max_gaussians or math.inf
    if len(points) > limit:
        chosen = torch.randperm(len(points), generator=generator)[: int(limit)]
        points = Points(points.xyz[chosen], points.rgb[chosen])
    gaussians = Gaussians.from_points(points.to(device), config.sh_degree, config.initial_opacity)
    gaussians.log_scales += math.log(config.initial_scale)
    check_finite(
        message("the points of the dataset"),
        gaussians.parameters(),
        message("remove points that are extremely far from the others"),
    )
    return gaussians.select(morton_order(gaussians.means))


def _points_of(
    starts: tuple[str, ...],
    dataset: Dataset,
    config: TrainConfig,
    images: Photos,
    generator: torch.Generator,
) -> Points:
    count = 0 if starts == ("points",) else config.points_per_start
    sizes = {"sweep": {"longer_side": config.sweep_side}}
    found = [
        start_of(name)(dataset, images, count, generator, **sizes.get(name, {})) for name in starts
    ]
    return Points(torch.cat([p.xyz for p in found]), torch.cat([p.rgb for p in found]))
