"""Where the Gaussians of an anamorph begin: discs that face the sides, in a cube.

Side 0 sees the cube from the front, side 1 from the right, side 2 from above. A disc that faces one
side is seen edge-on from the others, so it has an effect on one picture only. For each side, the
discs are a grid of n × n cells; `Shape` says how deep in the cube each of them lies.

- ``cloud``: at random. From elsewhere, one sees confetti.
- ``solid``: on the steps of a pile of blocks in the corner that is farthest from all sides. The
  pile is a *plane partition*: it contains with a block all others between it and the corner. So
  each line of sight along an axis meets it once, on a face that only this side sees.
"""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, normalize

from snowsplat.extras.anamorph.options import Shape
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at, quat_from_rotation
from snowsplat.scene.sh_constants import SH_C0

#: Of a camera from the middle of the cube, whose edges have the length 1.
DISTANCE = 12.0
#: The width of a photo at the middle of the cube.
FIELD = 1.15
#: The direction to each side, and the direction that is up in its picture.
SIDES = (((0, 0, -1), (0, -1, 0)), ((1, 0, 0), (0, -1, 0)), ((0, -1, 0), (0, 0, 1)))
# Standard deviations of a disc, in widths of a cell.
_SIGMAS = (0.6, 0.6, 0.02)
_OPACITY: dict[Shape, float] = {"cloud": 0.95, "solid": 0.99}
_BLOCK = 4  # cells along an edge of a block
_WALL = 3  # blocks: the least thickness of the pile
_WAVE = 0.5  # height of the waves on it, in `_pile`
_BACK = 0.25  # the grey of its back
#: Directions to the cameras around a solid: to the corners and edges of the cube.
AROUND = [
    place for place in itertools.product((-1.0, 0.01, 1.0), repeat=3) if sum(map(abs, place)) > 1.1
]


def camera_of(side: int, size: int) -> Camera:
    """The camera of a side, for square images of ``size`` pixels."""
    return _camera(*SIDES[side], size, FIELD)


def camera_around(direction: Sequence[float], size: int) -> Camera:
    """A camera that sees the whole cube, for square images of ``size`` pixels."""
    return _camera(direction, (0, -1, 0), size, math.sqrt(3) * FIELD)


def _camera(direction: Sequence[float], up: Sequence[float], size: int, field: float) -> Camera:
    place = DISTANCE * normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    pose = look_at(place, torch.zeros_like(place), torch.tensor(up, dtype=torch.float64))
    focal = size * DISTANCE / field
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)


def arranged(pictures: list[Tensor], n: int, shape: Shape, seed: int) -> Gaussians:
    """The first Gaussians for 2 or 3 pictures (S, S, 3) in 0..1: n² discs for each.

    A solid needs 3 pictures, and has n² discs for each of its three backs, too.
    """
    sides = [camera_of(side, 1).cam_from_world[:, :3].float() for side in range(len(pictures))]
    cells = [_cells(picture, n) for picture in pictures]
    if shape == "solid":
        # From behind, one sees the walls of the corner. Left and right are exchanged.
        mirrored = torch.tensor([-1.0, 1.0, -1.0])[:, None]
        sides += [mirrored * axes for axes in sides]
        cells += [torch.full((n * n, 3), _BACK)] * 3
        ahead = torch.cat([_pile(n), torch.full((3, n, n), -0.5)])
    else:
        ahead = torch.rand(len(sides), n, n, generator=torch.Generator().manual_seed(seed)) - 0.5
    across = (torch.arange(n) + 0.5) / n - 0.5
    down, right = torch.cartesian_prod(across, across).T
    means, quats = [], []
    for axes, depth in zip(sides, ahead.flatten(1), strict=True):  # rows: right, down, ahead
        # In a cloud, a cell covers the same part of the picture at each depth.
        wide = 1 + depth / DISTANCE if shape == "cloud" else torch.ones_like(depth)
        means.append(torch.stack([right * wide, down * wide, depth], dim=1) @ axes)
        quats.append(quat_from_rotation(axes.T.double()).float().expand(n * n, 4))
    count = n * n * len(sides)
    return Gaussians(
        torch.cat(means),
        torch.tensor(_SIGMAS).div(n).log().repeat(count, 1),
        torch.cat(quats),
        torch.full((count,), float(torch.logit(torch.tensor(_OPACITY[shape])))),
        (torch.cat(cells) - 0.5)[:, None] / SH_C0,
        torch.zeros(count, 0, 3),
        antialiased=True,  # a disc that is thinner than a pixel hides less
    )


def _cells(picture: Tensor, n: int) -> Tensor:
    """(n², 3): the mean colours of the cells."""
    return adaptive_avg_pool2d(picture.permute(2, 0, 1), n).flatten(1).T


def _pile(n: int) -> Tensor:
    """(3, n, n): the depths of the cells on a pile, from −0.5 (near) to 0.5, seen from each side.

    Let a, b and c be the distances of a block from the left, the lower and the back wall. The pile
    is c < h(a, b), a sum of logits with waves, which reaches six edges of the cube and is flat
    almost nowhere. Its faces that look to the right are where a line along a leaves it.
    """
    m = -(-n // _BLOCK)
    place = (torch.arange(m) + 0.5) / m
    a, b = place, place[:, None]
    waves = _WAVE * (torch.sin(7 * (a - 2 * b)) + torch.sin(7 * (2 * a + b)))
    h = (m * torch.sigmoid(waves - torch.logit(a) - torch.logit(b))).round().clamp(min=_WALL)
    h[:_WALL] = h[:, :_WALL] = m
    h = h.sort(0, descending=True)[0].sort(1, descending=True)[0]  # (b, a)
    inside = h[:, :, None] > torch.arange(m)  # (b, a, c)
    front = h.flip(0)  # rows from above
    right = inside.sum(1).flip(0).flip(1)  # (b, c), columns from the front
    above = inside.sum(0).T  # (c, a), rows from behind
    cell = torch.arange(n) * m // n
    return 0.5 - torch.stack([front, right, above])[:, cell[:, None], cell] / m
