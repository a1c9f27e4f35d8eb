"""`points_in_frusta` and `points_in_spheres`: which cameras show a point, and which are near it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_tensor, variant
from snowsplat.ops.native import launch


@dataclass(frozen=True)
class Frusta:
    """The parts of space that V cameras show; all tensors have the same dtype and device.

    Attributes:
        to_image: (V, 3, 4), K [R | t]: a world point x is shown at (u, v) pixels with the depth z,
            where (u z, v z, z) = K [R | t] (x, 1).
        size: (V, 2), width and height of the image in pixels.
        depths: (V, 2), the range of depths, without its ends; world units.
        focal: (V,), focal lengths in pixels.
    """

    to_image: Tensor
    size: Tensor
    depths: Tensor
    focal: Tensor

    def __len__(self) -> int:
        return len(self.to_image)

    def to(self, like: Tensor) -> Frusta:
        """The same frusta, with the dtype and device of another tensor."""
        return Frusta(*(part.to(like) for part in vars(self).values()))


@torch.no_grad()
def points_in_frusta(points: Tensor, frusta: Frusta) -> tuple[Tensor, Tensor]:
    """The number of frusta that contain each of points (N, 3), and its largest sampling rate.

    A frustum contains the points whose depth is in its range, and whose pixel (u, v) is in its
    image, 0 ≤ u < width and 0 ≤ v < height. It samples a point at depth z with the rate focal / z,
    in pixels per world unit. Not differentiable.

    Returns:
        counts (N,) and rates (N,), of the dtype of the points; the rate is 0 where the count is 0.
        Points that are not finite are in no frustum.

    Raises:
        ValueError: a wrong shape, dtype or device.
    """
    op = "points_in_frusta"
    check_float(op, "points", points)
    check_tensor(op, "points", points, (None, 3), points)
    views = len(frusta)
    check_tensor(op, "to_image", frusta.to_image, (views, 3, 4), points)
    check_tensor(op, "size", frusta.size, (views, 2), points)
    check_tensor(op, "depths", frusta.depths, (views, 2), points)
    check_tensor(op, "focal", frusta.focal, (views,), points)
    counts, rates = points.new_empty(len(points)), points.new_empty(len(points))
    launch(
        variant(op, points),
        n=len(points),
        points=points.detach().contiguous(),
        views=views,
        to_image=frusta.to_image.contiguous(),
        size=frusta.size.contiguous(),
        depths=frusta.depths.contiguous(),
        focal=frusta.focal.contiguous(),
        counts=counts,
        rates=rates,
    )
    return counts, rates


@torch.no_grad()
def points_in_spheres(points: Tensor, spheres: Tensor) -> tuple[Tensor, Tensor]:
    """The number of spheres that contain each of points (N, 3), and how far the nearest one is.

    Args:
        spheres: (C, 4), centre and radius in world units. A sphere contains the points whose
            distance from its centre is smaller than its radius. Not differentiable.

    Returns:
        counts (N,), and the distance (N,) of the nearest centre, inf if there are none; of the
        dtype of the points.

    Raises:
        ValueError: a wrong shape, dtype or device.
    """
    op = "points_in_spheres"
    check_float(op, "points", points)
    check_tensor(op, "points", points, (None, 3), points)
    check_tensor(op, "spheres", spheres, (None, 4), points)
    counts, nearest = points.new_empty(len(points)), points.new_empty(len(points))
    launch(
        variant(op, points),
        n=len(points),
        points=points.detach().contiguous(),
        count=len(spheres),
        spheres=spheres.contiguous(),
        counts=counts,
        nearest=nearest,
    )
    return counts, nearest
