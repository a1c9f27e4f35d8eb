"""Gaussians, rectangles and triangles, fitted to an image by gradient descent in PyTorch.

The image is background + Σ w c, for all three. The weight w of a Gaussian is exp(−½ r²), where r is
the distance from its centre in standard deviations. The weight of the others is the product of one
logistic function per edge, w = Π σ(d / s): d is the distance of the pixel from the edge in pixels,
positive inside, and s is the softness of the shape, which is learnt. Liu et al. 2019 (Soft
Rasterizer, arXiv:1904.01786) use the logistic function of a distance in the same way.

Positions, sizes and rates are chosen in the same way for all three, and the same code renders them:
only the primitives differ. A pixel is composited only with the shapes near its tile. The lists of
these shapes are renewed every `_RENEWED` steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Kind = Literal["gaussians", "rectangles", "triangles"]
#: Numbers of a primitive: geometry, softness (not of Gaussians), colour.
NUMBERS: dict[Kind, int] = {"gaussians": 5 + 3, "rectangles": 5 + 1 + 3, "triangles": 6 + 1 + 3}
#: Steps after which the lists of the shapes of each tile are renewed.
_RENEWED = 20
_TILE = 8  # pixels
# A shape reaches this many times its softness beyond its edges: σ(−5) = 0.007. A Gaussian reaches
# this many standard deviations: exp(−½ 3.2²) = 0.006.
_REACH, _DEVIATIONS = 5.0, 3.2
# Learning rates of the first step, for Adam.
_PIXELS, _LOGS, _COLORS, _BACKGROUND = 0.3, 0.05, 0.01, 0.003


@dataclass
class ShapeFit:
    """The result of `fit_shapes`: the image (H, W, 3)."""

    image: Tensor
    parameters: int


def fit_shapes(
    target: Tensor, count: int, kind: Kind, steps: int, seed: int, rate: float = 1.0
) -> ShapeFit:
    """Fit `count` shapes to target (H, W, 3) in 0..1 with Adam, for the mean squared error.

    Gaussians have a centre, two log standard deviations and an angle; rectangles a centre, two log
    half sides and an angle; triangles three corners. `rate` is a factor of all learning rates.
    """
    generator = torch.Generator().manual_seed(seed)
    height, width = target.shape[:2]
    pixels_part, logs_part = _initial(target, count, kind, generator)
    softness = torch.full((0 if kind == "gaussians" else count,), math.log(0.7))
    rows = pixels_part[:, :2].clamp(min=0).long()
    at = target[rows[:, 1].clamp(max=height - 1), rows[:, 0].clamp(max=width - 1)]
    background = target.mean((0, 1))
    colors = 0.5 * (at - background)
    rates = (_PIXELS, _LOGS, _LOGS, _COLORS, _BACKGROUND)
    leaves = [pixels_part, logs_part, softness, colors, background]
    for leaf in leaves:
        leaf.requires_grad_()
    optimizer = torch.optim.Adam(
        [{"params": [leaf], "lr": rate * lr} for leaf, lr in zip(leaves, rates, strict=True)]
    )
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.02 ** (1 / steps))
    pixels, inside = _tile_pixels(width, height)
    wanted = _to_tiles(target)

    def rendered(lists: Tensor, used: Tensor) -> Tensor:
        forms = _forms(torch.cat([pixels_part, logs_part], dim=1), softness, kind)
        return _render_tiles(forms, kind, colors, background, pixels, lists, used)

    def lists() -> tuple[Tensor, Tensor]:
        geometry = torch.cat([pixels_part, logs_part], dim=1)
        return _shapes_of_tiles(geometry, softness, kind, width, height)

    near = lists()
    for step in range(steps):
        if step % _RENEWED == 0:
            near = lists()
        loss = ((rendered(*near) - wanted).square() * inside[..., None]).sum() / inside.sum() / 3
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        image = _from_tiles(rendered(*lists()), width, height)
    return ShapeFit(image, sum(leaf.numel() for leaf in leaves))


def _initial(
    target: Tensor, count: int, kind: Kind, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Small shapes, more of them where the gradient of the image is large.

    Returns the numbers in pixels, (N, 2) or (N, 6), and log sizes and angle, (N, 3) or (N, 0).
    """
    height, width = target.shape[:2]
    slope = torch.zeros(height, width)
    slope[:, :-1] += (target[:, 1:] - target[:, :-1]).norm(dim=2)
    slope[:-1] += (target[1:] - target[:-1]).norm(dim=2)
    density = 0.7 * slope / slope.sum() + 0.3 / slope.numel()
    index = torch.multinomial(density.flatten(), count, generator=generator)
    centres = torch.stack([index % width, index // width], dim=1) + 0.5
    size = (1 / (count * density.flatten()[index]).sqrt()).clamp(1.5, 40)
    angle = 2 * math.pi * torch.rand(count, generator=generator)
    if kind != "triangles":
        log_size = (0.6 * size).log()
        return centres, torch.stack([log_size, log_size, angle], dim=1)
    corners = [
        centres + size[:, None] * torch.stack([(angle + turn).cos(), (angle + turn).sin()], dim=1)
        for turn in (0.0, 2 * math.pi / 3, 4 * math.pi / 3)
    ]
    return torch.cat(corners, dim=1), torch.zeros(count, 0)


def _forms(geometry: Tensor, softness: Tensor, kind: Kind) -> Tensor:
    """(N, E, 3): a, b, c of each linear form a x + b y + c of the position, without a unit.

    Of a Gaussian: the position along its two axes, in standard deviations. Of the others: for each
    edge, the distance inside it, in units of the softness.
    """
    if kind == "triangles":
        corners = geometry.view(-1, 3, 2)
        side = corners.roll(-1, dims=1) - corners
        normal = torch.stack([-side[..., 1], side[..., 0]], dim=2)
        normal = normal / normal.norm(dim=2, keepdim=True).clamp(min=1e-6)
        # The normals point inside, whichever way round the corners are.
        third = corners.roll(1, dims=1)
        normal = normal * (normal * (third - corners)).sum(2, keepdim=True).sign()
        edges = torch.cat([normal, -(normal * corners).sum(2, keepdim=True)], dim=2)
        return edges / softness.exp()[:, None, None]
    x, y, log_u, log_v, angle = geometry.unbind(1)
    cos, sin = angle.cos(), angle.sin()
    forms = []
    for nx, ny, size in ((cos, sin, log_u.exp()), (-sin, cos, log_v.exp())):
        along = nx * x + ny * y
        if kind == "gaussians":
            forms.append(torch.stack([nx / size, ny / size, -along / size], dim=1))
        else:
            forms.append(torch.stack([nx, ny, size - along], dim=1))
            forms.append(torch.stack([-nx, -ny, size + along], dim=1))
    stacked = torch.stack(forms, dim=1)
    return stacked if kind == "gaussians" else stacked / softness.exp()[:, None, None]


@torch.no_grad()
def _shapes_of_tiles(
    geometry: Tensor, softness: Tensor, kind: Kind, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """(T, K) rows of the shapes near each tile, padded with 0, and (T, K) 1 where it is not."""
    if kind == "triangles":
        corners = geometry.view(-1, 3, 2)
        centres = corners.mean(1)
        radii = (corners - centres[:, None]).norm(dim=2).amax(1)
    else:
        centres, sizes = geometry[:, :2], geometry[:, 2:4].exp()
        radii = _DEVIATIONS * sizes.amax(1) if kind == "gaussians" else sizes.norm(dim=1)
    reach = radii + 2.0  # pixels, for the steps until the next lists
    if kind != "gaussians":
        reach = reach + _REACH * softness.exp()
    lists = []
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            low = torch.tensor([left, top])
            nearest = centres.clamp(low, low + _TILE)
            lists.append(((centres - nearest).norm(dim=1) < reach).nonzero()[:, 0])
    used = torch.nn.utils.rnn.pad_sequence([torch.ones(len(rows)) for rows in lists], True)
    return torch.nn.utils.rnn.pad_sequence(lists, True), used


def _render_tiles(
    forms: Tensor,
    kind: Kind,
    colors: Tensor,
    background: Tensor,
    pixels: Tensor,
    lists: Tensor,
    used: Tensor,
) -> Tensor:
    """(T, P, 3): the pixels of each tile."""
    values = [
        torch.baddbmm(form[:, None, :, 2], pixels, form[:, :, :2].transpose(1, 2))  # (T, P, K)
        for form in forms[lists].unbind(2)
    ]
    weight = used[:, None, :]
    if kind == "gaussians":
        u, v = values
        weight = weight * (-0.5 * (u * u + v * v)).exp()
    else:
        for value in values:
            weight = weight * torch.sigmoid(value)
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
