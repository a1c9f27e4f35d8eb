"""Cuts the ground plane into cells with equal shares of the cameras and of the points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

#: The two axes of the ground plane, unit vectors in the world frame.
Axes = tuple[tuple[float, float, float], tuple[float, float, float]]
# The size of a cell in a direction is the distance between these quantiles of its content.
# Distant points, such as those of the sky, would make it too large.
_INNER = (0.05, 0.95)


@dataclass(frozen=True)
class Cell:
    """A half-open box of the ground plane, low <= x < high; None: it is not limited there.

    Neighbours share a border, and the outermost cells have no limit: every point of the plane is
    in exactly one cell.
    """

    low: tuple[float | None, float | None] = (None, None)
    high: tuple[float | None, float | None] = (None, None)

    def contains(self, ground: Tensor, margin: Sequence[float] | Tensor = (0.0, 0.0)) -> Tensor:
        """(N,) bool: the points (N, 2) of the plane that are in the cell.

        ``margin``: by which the cell is expanded in both directions; or one for each point, (N, 2).
        """
        margins = torch.as_tensor(margin, dtype=torch.float64).expand(len(ground), 2)
        inside = torch.ones(len(ground), dtype=torch.bool)
        for axis in range(2):
            low, high = self.low[axis], self.high[axis]
            if low is not None:
                inside &= ground[:, axis] >= low - margins[:, axis]
            if high is not None:
                inside &= ground[:, axis] < high + margins[:, axis]
        return inside

    def split(self, axis: int, at: float) -> tuple[Cell, Cell]:
        """The parts below and above ``at``."""

        def changed(values: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
            return (at, values[1]) if axis == 0 else (values[0], at)

        return replace(self, high=changed(self.high)), replace(self, low=changed(self.low))


def ground_axes(positions: Tensor) -> Tensor:
    """(2, 3) float64: the two directions in which the camera centres (C, 3) vary most."""
    offsets = positions.to(torch.float64)
    offsets = offsets - offsets.mean(0)
    _, directions = torch.linalg.eigh(offsets.T @ offsets)  # ascending
    axes = directions.T.flip(0)[:2]
    # The sign of an eigenvector is arbitrary. Its largest component is made positive.
    largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
    return axes * largest.sign()


def cut(cameras: Tensor, points: Tensor, count: int) -> list[Cell]:
    """``count`` cells with about equal content, ordered along the first direction.

    Half of the content are the cameras (C, 2), the other half the points (P, 2). A cell is halved
    across the direction in which its content is longer, until there are ``count`` cells.
    """
    ground = torch.cat([cameras, points]).to(torch.float64)
    sizes = torch.tensor([len(cameras), len(points)])
    weights = (1.0 / sizes.clamp(min=1).double()).repeat_interleave(sizes)
    return _cut(Cell(), ground, weights, count)


def extent(ground: Tensor) -> tuple[float, float]:
    """The size of the inner part of points (N, 2) in both directions; 0 without points."""
    if not len(ground):
        return 0.0, 0.0
    ordered = ground.sort(0).values
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in _INNER)
    x, y = (high - low).tolist()
    return x, y


def _cut(cell: Cell, ground: Tensor, weights: Tensor, count: int) -> list[Cell]:
    if count == 1:
        return [cell]
    size = extent(ground)
    axis = 0 if size[0] >= size[1] else 1
    below = count // 2
    at = _quantile(ground[:, axis], weights, below / count)
    low, high = cell.split(axis, at)
    is_low = ground[:, axis] < at
    return [
        *_cut(low, ground[is_low], weights[is_low], below),
        *_cut(high, ground[~is_low], weights[~is_low], count - below),
    ]


def _quantile(values: Tensor, weights: Tensor, share: float) -> float:
    """A value with this share of the weight below it; between two values, if they differ."""
    ordered, index = values.sort()
    total = weights[index].cumsum(0)
    found = int(torch.searchsorted(total, share * float(total[-1])).clamp(0, len(values) - 2))
    at = float((ordered[found] + ordered[found + 1]) / 2)
    assert math.isfinite(at)
    return at
