"""Rectangles and triangles with soft edges, fitted to an image by gradient descent in PyTorch.

The image is background + Σ w c, as for additive Gaussians. The weight w of a shape is the product
of one logistic function per edge, w = Π σ(d / s): d is the distance of the pixel from the edge in
pixels, positive inside, and s is the softness of the shape, which is learnt. Liu et al. 2019 (Soft
Rasterizer, arXiv:1904.01786) use the logistic function of a distance in the same way.

A pixel is composited only with the shapes near its tile. The lists of these shapes are renewed
every `_RENEWED` steps.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

#: Steps after which the lists of the shapes of each tile are renewed.
_RENEWED = 20
_TILE = 16  # pixels
# A shape reaches this many times its softness beyond its edges: σ(−5) = 0.007.
_REACH = 5.0


@dataclass
class ShapeFit:
    """The result of `fit_shapes`: the image (H, W, 3), and the seconds that the fit took."""

    image: Tensor
    seconds: float
    parameters: int


def fit_shapes(target: Tensor, count: int, kind: str, steps: int, seed: int) -> ShapeFit:
    """Fit `count` shapes to target (H, W, 3) in 0..1 with Adam, for the mean squared error.

    kind: "rectangles" (centre, half width, half height, angle) or "triangles" (three corners).
    """
    generator = torch.Generator().manual_seed(seed)
    height, width = target.shape[:2]
    geometry = _initial(target, count, kind, generator)
    softness = torch.full((count,), math.log(0.7))
    rows = (geometry[:, :2].clamp(0, 1e9)).long()
    at = target[rows[:, 1].clamp(max=height - 1), rows[:, 0].clamp(max=width - 1)]
    background = target.mean((0, 1))
    colors = 0.5 * (at - background)
    leaves = [geometry, softness, colors, background]
    for leaf in leaves:
        leaf.requires_grad_()
    rates = (0.3, 0.02, 0.01, 0.003)
    optimizer = torch.optim.Adam(
        [{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates, strict=True)]
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.02 ** (1 / steps))
    pixels, inside = _tile_pixels(width, height)
    wanted = _to_tiles(target)
    start = time.perf_counter()
    lists, used = None, None
    for step in range(steps):
        if step % _RENEWED == 0:
            lists, used = _shapes_of_tiles(geometry, softness, kind, width, height)
        image = _render_tiles(geometry, softness, colors, background, kind, pixels, lists, used)
        loss = ((image - wanted).square() * inside[..., None]).sum() / inside.sum() / 3
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    seconds = time.perf_counter() - start
    with torch.no_grad():
        lists, used = _shapes_of_tiles(geometry, softness, kind, width, height)
        image = _render_tiles(geometry, softness, colors, background, kind, pixels, lists, used)
    return ShapeFit(
        _from_tiles(image, width, height), seconds, sum(leaf.numel() for leaf in leaves)
    )


def _initial(target: Tensor, count: int, kind: str, generator: torch.Generator) -> Tensor:
    """(N, 5) or (N, 6): small shapes, more of them where the gradient of the image is large."""
    height, width = target.shape[:2]
    slope = torch.zeros(height, width)
    slope[:, :-1] += (target[:, 1:] - target[:, :-1]).norm(dim=2)
    slope[:-1] += (target[1:] - target[:-1]).norm(dim=2)
    density = 0.7 * slope / slope.sum() + 0.3 / slope.numel()
    index = torch.multinomial(density.flatten(), count, generator=generator)
    centres = torch.stack([index % width, index // width], dim=1) + 0.5
    size = (1 / (count * density.flatten()[index]).sqrt()).clamp(1.5, 40)
    angle = 2 * math.pi * torch.rand(count, generator=generator)
    if kind == "rectangles":
        half = 0.6 * size
        return torch.stack([*centres.T, half.log(), half.log(), angle], dim=1)
    corners = [
        centres + size[:, None] * torch.stack([(angle + turn).cos(), (angle + turn).sin()], dim=1)
        for turn in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)
    ]
    return torch.cat(corners, dim=1)


def _edges(geometry: Tensor, kind: str) -> Tensor:
    """(N, E, 3): a, b, c of each edge; a x + b y + c is the distance inside the edge, in pixels."""
    if kind == "rectangles":
        x, y, log_u, log_v, angle = geometry.unbind(1)
        cos, sin = angle.cos(), angle.sin()
        edges = []
        for nx, ny, half in ((cos, sin, log_u.exp()), (-sin, cos, log_v.exp())):
            along = nx * x + ny * y
            edges.append(torch.stack([nx, ny, half - along], dim=1))
            edges.append(torch.stack([-nx, -ny, half + along], dim=1))
        return torch.stack(edges, dim=1)
    corners = geometry.view(-1, 3, 2)
    following = corners.roll(-1, dims=1)
    side = following - corners
    normal = torch.stack([-side[..., 1], side[..., 0]], dim=2)
    normal = normal / normal.norm(dim=2, keepdim=True).clamp(min=1e-6)
    # The normals point inside, whichever way round the corners are.
    third = corners.roll(1, dims=1)
    sign = (normal * (third - corners)).sum(2, keepdim=True).sign()
    normal = normal * sign
    return torch.cat([normal, -(normal * corners).sum(2, keepdim=True)], dim=2)


@torch.no_grad()
def _shapes_of_tiles(
    geometry: Tensor, softness: Tensor, kind: str, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """(T, K) rows of the shapes near each tile, padded with 0, and (T, K) 1 where it is not."""
    if kind == "rectangles":
        centres, radii = geometry[:, :2], geometry[:, 2:4].exp().norm(dim=1)
    else:
        corners = geometry.view(-1, 3, 2)
        centres = corners.mean(1)
        radii = (corners - centres[:, None]).norm(dim=2).amax(1)
    reach = radii + _REACH * softness.exp() + 2.0  # pixels; 2: for the steps until the next lists
    lists = []
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            low = torch.tensor([left, top])
            nearest = centres.clamp(low, low + _TILE)
            lists.append(((centres - nearest).norm(dim=1) < reach).nonzero()[:, 0])
    used = torch.nn.utils.rnn.pad_sequence([torch.ones(len(rows)) for rows in lists], True)
    return torch.nn.utils.rnn.pad_sequence(lists, True), used


def _render_tiles(
    geometry: Tensor,
    softness: Tensor,
    colors: Tensor,
    background: Tensor,
    kind: str,
    pixels: Tensor,
    lists: Tensor,
    used: Tensor,
) -> Tensor:
    """(T, P, 3): the pixels of each tile."""
    edges = (_edges(geometry, kind) / softness.exp()[:, None, None])[lists]  # (T, K, E, 3)
    weight = used[:, None, :]
    for edge in edges.unbind(2):
        distance = torch.baddbmm(edge[:, None, :, 2], pixels, edge[:, :, :2].transpose(1, 2))
        weight = weight * torch.sigmoid(distance)  # (T, P, K)
    return background + torch.bmm(weight, colors[lists])


def _tile_pixels(width: int, height: int) -> tuple[Tensor, Tensor]:
    """(T, P, 2) pixel centres of each tile, and (T, P): 1 inside of the image, else 0."""
    y, x = torch.meshgrid(
        torch.arange(-(-height // _TILE) * _TILE),
        torch.arange(-(-width // _TILE) * _TILE),
        indexing="ij",
    )
    inside = ((x < width) & (y < height)).float()[..., None]
    return _to_tiles(torch.stack([x, y], dim=2) + 0.5), _to_tiles(inside)[..., 0]


def _to_tiles(image: Tensor) -> Tensor:
    """(H, W, C) to (T, P, C), padded with zeros."""
    height, width, channels = image.shape
    padded = torch.nn.functional.pad(image, (0, 0, 0, -width % _TILE, 0, -height % _TILE))
    rows, columns = padded.shape[0] // _TILE, padded.shape[1] // _TILE
    tiles = padded.view(rows, _TILE, columns, _TILE, channels).transpose(1, 2)
    return tiles.reshape(rows * columns, _TILE * _TILE, channels)


def _from_tiles(tiles: Tensor, width: int, height: int) -> Tensor:
    """(T, P, C) to (H, W, C)."""
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    image = tiles.view(rows, columns, _TILE, _TILE, -1).transpose(1, 2)
    return image.reshape(rows * _TILE, columns * _TILE, -1)[:height, :width]
