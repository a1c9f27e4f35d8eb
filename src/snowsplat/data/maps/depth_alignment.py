"""Fits the scale of a depth map, and the shift of its disparity, to 3D points of the same scene."""

from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError

# Fewest points that the photo must show.
_LEAST_POINTS = 20
_PAIRS = 500  # random pairs of points that are tried
_ROUNDS = 20  # of reweighted least squares
# Residual in disparity, relative to the median disparity, at which a point has half the weight.
_RESIDUAL = 0.03


@dataclass(frozen=True)
class Alignment:
    """1 / z_world = scale · (1 / z_map) + shift.

    Attributes:
        scale: map units per world unit.
        shift: in 1 / world units; 0 for depths that are known up to a factor.
        points: number of points in the photo.
        error: the median of the absolute residuals, relative to the median disparity.
        spread: the median of the absolute deviations of the disparities of the points from their
            median, relative to it: the error of a map of one depth.
    """

    scale: float
    shift: float
    points: int
    error: float
    spread: float

    def apply(self, depth: Tensor) -> Tensor:
        """The depth map in world units; NaN where the disparity is not positive."""
        disparity = self.scale / depth + self.shift
        return torch.where(disparity > 0, 1.0 / disparity, torch.nan)


def align(depth: Tensor, points: Tensor, camera: Camera, *, with_shift: bool) -> Alignment:
    """Fit the disparities of a depth map to those of points, with robust least squares.

    Points that are hidden in the photo are outliers, and so are errors of the map. Therefore, the
    fit starts with the best of many random pairs of points (RANSAC), and continues with least
    squares, reweighted with Cauchy's function.

    Args:
        depth: (H, W) positive, in any unit; NaN where it is unknown.
        points: (P, 3) in the world frame.
        camera: the camera of the depth map.
        with_shift: also fit a shift of the disparity, which networks for relative depth leave open.

    Raises:
        UserError: too few points are in the photo, or the fit has no positive scale.
    """
    pixels, z = camera.project(points.double())
    column, row = pixels.floor().long().unbind(1)
    seen = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    at = depth[row[seen], column[seen]].double()
    x, y = 1.0 / at, 1.0 / z[seen]
    x, y = x[at.isfinite()], y[at.isfinite()]
    if len(x) < _LEAST_POINTS:
        raise UserError(
            "only {x} points of the dataset are in the photo; aligning the depth needs "
            "{least_points}, use another photo",
            x=len(x),
            least_points=_LEAST_POINTS,
        )
    limit = _RESIDUAL * float(y.median())
    scale, shift = _best_pair(x, y, limit, with_shift)
    for _ in range(_ROUNDS):
        residuals = y - scale * x - shift
        weights = 1.0 / (1.0 + (residuals / limit).square())
        scale, shift = _least_squares(x, y, weights, with_shift)
    if not scale > 0.0:
        raise UserError(
            "the depth map contradicts the points of the dataset: the fitted scale is not "
            "positive; check `depth_is`, and that the map belongs to this photo"
        )
    middle = y.median()
    error = float((y - scale * x - shift).abs().median() / middle)
    spread = float((y - middle).abs().median() / middle)
    return Alignment(scale, shift, len(x), error, spread)


def _best_pair(x: Tensor, y: Tensor, limit: float, with_shift: bool) -> tuple[float, float]:
    """The line through a pair of points, or through the origin and a point, with most inliers."""
    random = torch.Generator().manual_seed(0)
    i, j = torch.randint(len(x), (2, _PAIRS), generator=random)
    if with_shift:
        scales = (y[i] - y[j]) / (x[i] - x[j])
        shifts = y[i] - scales * x[i]
    else:
        scales, shifts = y[i] / x[i], torch.zeros_like(y[i])
    usable = scales.isfinite() & (scales > 0)
    if not bool(usable.any()):
        return float((y / x).median()), 0.0
    scales, shifts = scales[usable], shifts[usable]
    inliers = ((y - scales[:, None] * x - shifts[:, None]).abs() < limit).sum(1)
    best = int(inliers.argmax())
    return float(scales[best]), float(shifts[best])


def _least_squares(x: Tensor, y: Tensor, weights: Tensor, with_shift: bool) -> tuple[float, float]:
    if not with_shift:
        return float((weights * x * y).sum() / (weights * x * x).sum()), 0.0
    total = weights.sum()
    mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
    spread = (weights * (x - mean_x).square()).sum()
    if float(spread) <= 1e-12 * float(mean_x.square() * total):  # a map of one depth
        return float(mean_y / mean_x), 0.0
    scale = (weights * (x - mean_x) * (y - mean_y)).sum() / spread
    return float(scale), float(mean_y - scale * mean_x)
