"""`in_far_regions`: which regions of the sphere of directions are much farther away than the scene.

A wall of one colour, too, has the same colour in the same direction, wherever the camera is. But
the light falls off along a wall, and a sky has clouds and gradients. If a region is very far away,
all photos show them in the same directions; otherwise, parallax displaces them. So the photos are
compared as if the region were on a sphere around the cameras, with several radii, the largest one
infinite: a sweep as in plane-sweep stereo. A region is far if the photos agree best at infinity.

An overcast sky without any gradient agrees at every radius. But it is brighter than what it
illuminates, and nothing of the scene is above it. In a room, neither is usual for a wall which is
illuminated so evenly.

The sphere of directions in cells of similar size: a cube map. Statistics of values by cell.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

#: The finite radii, in units of the median depth of the points. The walls of a room are a few times
#: farther away than an object in its middle.
_RADII = (0.7, 1.0, 1.4, 2.0, 4.0, 8.0)
#: Photos agree clearly less at a radius up to this one if their residual is this many times as
#: large, and as well if it is at least this many times as large.
_NEAR, _CLEARLY, _AS_WELL = 2.0, 1.2, 0.95
#: The largest residual of photos that agree, in 0..255. The colours of foliage and gravel are the
#: same in some directions by chance; their residual is about 10.
_AGREE = 6.0
#: Standard deviation of the noise of colours in 0..255, which every residual contains.
_NOISE = 2.0
#: A region looks like an overcast sky if at least this share of its observations does.
_LOOKS_LIKE_SKY = 0.5
#: Regions of fewer cells show too little of their gradients.
_FEWEST_CELLS = 16
#: The offsets of the photos are found in this number of rounds.
_ROUNDS = 5
#: The residual at a radius is known if at least this share of the colours can be compared there.
_LEAST_OVERLAP = 0.3
#: A rotation by 60°. Colours have been found to be the same within cells; those of the sweep are
#: turned, so that infinity has no advantage.
_TURN = torch.tensor([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3.0
#: A face of the cube has this number of cells squared, 1.4° each.
SIDE = 64
COUNT = 6 * SIDE**2
#: The mean angle from a cell to the next one, in radians.
ANGLE = math.pi / (2 * SIDE)


def in_far_regions(
    cells: Tensor, photos: Tensor, colors: Tensor, overcast: Tensor, offsets: Tensor, depth: float
) -> Tensor:
    """Which of M observations, each of a cell in a photo, are of regions that are very far away.

    Args:
        cells: (M,) int64.
        photos: (M,) int64.
        colors: (M, 3) float32 in 0..255.
        overcast: (M,) bool: whether it looks like an overcast sky.
        offsets: (V, 3) float32: the positions of the cameras of all photos, relative to the middle
            of the cameras.
        depth: the median depth of the points, in the same unit.

    Returns: (M,) bool.
    """
    different, own = cells.unique(return_inverse=True)
    region_of_cell = regions_of(different)
    region = region_of_cell[own]
    directions, origins = directions_of(cells), offsets[photos]
    turn = _TURN.to(directions)
    far = _residuals(region, photos, colors, cells_of(directions @ turn))
    best, best_near = torch.full_like(far, torch.inf), torch.full_like(far, torch.inf)
    for radius in _RADII:
        distance = _distances(origins, directions, radius * depth)
        inside = distance > 0.0
        there = cells_of((origins + distance[:, None] * directions) @ turn)
        found = _residuals(region, photos, colors, torch.where(inside, there, -1))
        best = torch.minimum(best, found)
        if radius <= _NEAR:
            best_near = torch.minimum(best_near, found)
    looks_so = _means(region, overcast[:, None].to(torch.float32), len(far))[:, 0]
    agree = (far <= _AGREE) & (far * _AS_WELL <= best)
    decided = (far * _CLEARLY <= best_near) | (looks_so >= _LOOKS_LIKE_SKY)
    known = best_near.isfinite() & (torch.bincount(region_of_cell) >= _FEWEST_CELLS)
    return (known & agree & decided)[region]


def _distances(origins: Tensor, directions: Tensor, radius: float) -> Tensor:
    """(M,): along rays to a sphere around 0; 0 for rays that begin outside."""
    along = (origins * directions).sum(1)
    power = radius**2 - origins.square().sum(1)
    return torch.where(power > 0.0, (along.square() + power).clamp(min=0.0).sqrt() - along, 0.0)


def _residuals(region: Tensor, photos: Tensor, colors: Tensor, cells: Tensor) -> Tensor:
    """(R,): the standard deviation of the colours of different photos in the same cell, by region.

    The photos may have different exposures: each has an offset in each region.

    Args:
        region: (M,) int64.
        photos: (M,) int64.
        colors: (M, 3).
        cells: (M,) int64, at the radius; -1: the observation is left out.

    Returns: infinite where few colours can be compared.
    """
    regions, number, used = int(region.max()) + 1, int(photos.max()) + 1, cells >= 0
    # The mean colour of each photo in each cell of each region.
    place = (region * COUNT + cells)[used]
    value_of, own = (place * number + photos[used]).unique(return_inverse=True)
    values = _means(own, colors[used], len(value_of))
    place, own = (value_of // number).unique(return_inverse=True)
    compared = torch.bincount(own)[own] >= 2
    own, values, value_of = own[compared], values[compared], value_of[compared]
    its_region = value_of // number // COUNT
    source = its_region * number + value_of % number
    for _ in range(_ROUNDS):
        differences = values - _means(own, values, len(place))[own]
        values = values - _means(source, differences, regions * number)[source]
    differences = values - _means(own, values, len(place))[own]
    shown = torch.bincount(own)[own]
    squares = differences.square().mean(1) * shown / (shown - 1)
    residual = (_means(its_region, squares[:, None], regions)[:, 0] + _NOISE**2).sqrt()
    share = torch.bincount(its_region, minlength=regions) / torch.bincount(region)
    return torch.where(share >= _LEAST_OVERLAP, residual, torch.inf)


def _means(group: Tensor, values: Tensor, count: int) -> Tensor:
    """(count, C): the mean of the rows (M, C) of each group (M,); 0 without rows."""
    number = torch.bincount(group, minlength=count).clamp(min=1)[:, None]
    return values.new_zeros(count, values.shape[1]).index_add_(0, group, values) / number


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
