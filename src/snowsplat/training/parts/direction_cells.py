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
    return _directions(*_places_of(cells))


def regions_of(cells: Tensor) -> Tensor:
    """(M,) int64: the region of each of the different cells (M,), numbered from 0.

    A region is a set of cells each of which has a side in common with another one.
    """
    axis, side, column, row = _places_of(cells)
    device = cells.device
    place = torch.full((COUNT,), len(cells), device=device)
    place.index_put_((cells,), torch.arange(len(cells), device=device))
    # A cell beyond the edge of a face is on the next face.
    steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
    beside = [place[cells_of(_directions(axis, side, column + x, row + y))] for x, y in steps]
    region = torch.arange(len(cells) + 1, device=device)  # the last one stands for all other cells
    while True:
        lowest = torch.stack([region[:-1], *(region[next_to] for next_to in beside)]).amin(0)
        if torch.equal(lowest, region[:-1]):
            return lowest.unique(return_inverse=True)[1]
        region[:-1] = lowest[lowest]  # two steps at once: a number is that of a cell of the region


def _places_of(cells: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(M,) each: the axis and the side, -1 or 1, of the face of a cell; its column and row."""
    face, rest = cells // SIDE**2, cells % SIDE**2
    return face // 2, 2 * (face % 2) - 1, rest % SIDE, rest // SIDE


def _directions(axis: Tensor, side: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """(M, 3) float32, unit vectors: the middles of the cells at these places."""
    u, v = (torch.tan(((at + 0.5) * (2.0 / SIDE) - 1.0) * (math.pi / 4)) for at in (column, row))
    directions = u.new_zeros(len(axis), 3)
    directions.scatter_(1, axis[:, None], side[:, None].to(torch.float32))
    directions.scatter_(1, (axis[:, None] + 1) % 3, u[:, None])
    directions.scatter_(1, (axis[:, None] + 2) % 3, v[:, None])
    return normalize(directions, dim=1)


def median_of(group: Tensor, values: Tensor) -> Tensor:
    """(COUNT, C): the lower median of the rows (M, C) of each cell (M,); 0 without rows."""
    counts = torch.bincount(group, minlength=COUNT)
    middle = counts.cumsum(0) - counts + (counts - 1).clamp(min=0) // 2
    medians = torch.zeros(len(counts), values.shape[1], device=values.device)
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
    mean = positions.new_zeros(COUNT, 3).index_add_(0, group, positions) / number
    squares = (positions - mean[group]).square().sum(1)
    return (squares.new_zeros(COUNT).index_add_(0, group, squares) / number[:, 0]).sqrt()
