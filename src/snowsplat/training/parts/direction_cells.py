"""The sphere of directions in cells of similar size: a cube map. Statistics of values by cell."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

#: A face of the cube has this number of cells squared, 1.4° each.
SIDE = 64
COUNT = 6 * SIDE**2
#: The mean angle from a cell to the next one, in radians.
ANGLE = math.pi / (2 * SIDE)


def cells_of(directions: Tensor) -> Tensor:
    """The cell of each direction (..., 3): a cube map with cells of similar angles, int64."""
    axis = directions.abs().argmax(-1, keepdim=True)
    along = directions.gather(-1, axis)
    face = 2 * axis + (along > 0)
    others = [directions.gather(-1, (axis + i) % 3) for i in (1, 2)]
    u, v = (torch.atan(other / along.abs()) * (4.0 / math.pi) for other in others)
    column, row = (((side + 1.0) * (SIDE / 2)).long().clamp(0, SIDE - 1) for side in (u, v))
    return ((face * SIDE + row) * SIDE + column)[..., 0]


def directions_of(cells: Tensor) -> Tensor:
    """(M, 3) float32, unit vectors: the middles of cells (M,)."""
    column, rest = cells % SIDE, cells // SIDE
    row, face = rest % SIDE, rest // SIDE
    u, v = (
        torch.tan(((side + 0.5) * (2.0 / SIDE) - 1.0) * (math.pi / 4)) for side in (column, row)
    )
    axis = face[:, None] // 2
    directions = torch.zeros(len(cells), 3)
    directions.scatter_(1, axis, 2.0 * (face[:, None] % 2) - 1.0)
    directions.scatter_(1, (axis + 1) % 3, u[:, None])
    directions.scatter_(1, (axis + 2) % 3, v[:, None])
    return normalize(directions, dim=1)


def median_of(group: Tensor, values: Tensor) -> Tensor:
    """(COUNT, C): the lower median of the rows (M, C) of each cell (M,); 0 without rows."""
    counts = torch.bincount(group, minlength=COUNT)
    middle = counts.cumsum(0) - counts + (counts - 1).clamp(min=0) // 2
    medians = torch.zeros(len(counts), values.shape[1])
    for channel in range(values.shape[1]):
        column = values[:, channel]
        order = torch.argsort(column, stable=True)
        order = order[torch.argsort(group[order], stable=True)]
        medians[counts > 0, channel] = column[order][middle[counts > 0]]
    return medians


def spread_of(group: Tensor, positions: Tensor) -> Tensor:
    """(COUNT,): the root mean square distance of the positions (M, 3) of a cell from their
    mean."""
    number = torch.bincount(group, minlength=COUNT).clamp(min=1)[:, None]
    mean = torch.zeros(COUNT, 3).index_add_(0, group, positions) / number
    squares = (positions - mean[group]).square().sum(1)
    return (torch.zeros(COUNT).index_add_(0, group, squares) / number[:, 0]).sqrt()
