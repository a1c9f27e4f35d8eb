"""Images as targets: a ring, blobs and a small picture, drawn and fitted by `ops.rasterize`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from targets import AMPLITUDE, LOG_SIGMA, MEAN
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.splats import Splats2D

SIZE = 64


def draw(parameters: Tensor) -> Tensor:
    """(SIZE, SIZE): the sum of round Gaussians (K, 4), by the rasterizer of snowsplat.

    It skips a Gaussian where exp(−d²/2σ²) < 1/255. The amplitude is the colour, so that it may be
    negative.
    """
    x, y = parameters[:, MEAN].unbind(dim=1)
    conic = torch.exp(-2 * parameters[:, LOG_SIGMA])
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    # The columns of Splats2D: mean, conic, opacity, depth, radius, colour (1 of at most 4).
    rows = [x, y, conic, zero, conic, one, zero, zero, parameters[:, AMPLITUDE], *[zero] * 7]
    splats = Splats2D(torch.stack(rows, dim=1), None, 1)
    return ops.rasterize(splats, SIZE, SIZE, additive=True)[0][..., 0]


@dataclass(frozen=True)
class Picture:
    """An image (SIZE, SIZE) as the target of one restart (B = 1); the loss is a sum over pixels."""

    image: Tensor

    def loss(self, parameters: Tensor, blur: float) -> Tensor:
        return (draw(parameters[0]) - self._blurred(blur)).square().sum()[None] / 2

    def relative_error(self, parameters: Tensor) -> Tensor:
        error = (draw(parameters[0]) - self.image).square().sum()
        return (error / self.image.square().sum())[None]

    def psnr(self, parameters: Tensor) -> float:
        """PSNR in dB of the model (1, K, 4); 1 is white."""
        with torch.no_grad():
            error = (draw(parameters[0]) - self.image).square().mean()
        return float(-10 * error.log10())

    def places(self) -> Tensor:
        centres = torch.arange(SIZE, dtype=self.image.dtype) + 0.5
        y, x = torch.meshgrid(centres, centres, indexing="ij")
        return torch.stack([x.flatten(), y.flatten()], dim=1)

    def residual(self, parameters: Tensor) -> Tensor:
        with torch.no_grad():
            return (self.image - draw(parameters[0])).flatten()[None]

    def _blurred(self, sigma: float) -> Tensor:
        if sigma < 0.1:
            return self.image
        i = torch.arange(SIZE, dtype=self.image.dtype)
        kernel = torch.exp(-((i[:, None] - i) ** 2) / (2 * sigma**2))
        kernel = kernel / kernel.sum(dim=1, keepdim=True)
        return kernel @ self.image @ kernel.T


@cache
def ring() -> Tensor:
    """A ring with a radius of 20 and a width of 6 pixels."""
    return _smooth_step(3 - (_radius(32, 32) - 20).abs())


@cache
def blobs() -> Tensor:
    """Nine Gaussians with σ of 2 to 4 pixels, drawn exactly."""
    random = torch.Generator().manual_seed(7)
    image = torch.zeros(SIZE, SIZE)
    for _ in range(9):
        x, y, sigma, height = torch.rand(4, generator=random).tolist()
        radius = _radius(8 + 48 * x, 8 + 48 * y)
        image += (0.5 + 0.5 * height) * torch.exp(-(radius**2) / (2 * (2 + 2 * sigma) ** 2))
    return image


@cache
def landscape() -> Tensor:
    """A small picture: a sky with a sun, two hills, and a fence in front of them."""
    centres = torch.arange(SIZE) + 0.5
    y, x = torch.meshgrid(centres, centres, indexing="ij")
    image = 0.55 + 0.3 * y / SIZE
    image = torch.lerp(image, torch.ones_like(image), _smooth_step(8 - _radius(46, 15)))
    for level, height, length, phase in ((0.35, 36, 9, 0.3), (0.15, 46, 6, 2.0)):
        hill = height + 5 * torch.sin(x / length + phase)
        image = torch.lerp(image, torch.full_like(image, level), _smooth_step(y - hill))
    posts = _smooth_step(1.5 - ((x % 8) - 4).abs()) * _smooth_step(y - 52)
    return torch.lerp(image, torch.full_like(image, 0.9), posts)


def _radius(x: float, y: float) -> Tensor:
    """(SIZE, SIZE): the distance of each pixel from a point."""
    centres = torch.arange(SIZE) + 0.5
    return ((centres[:, None] - y) ** 2 + (centres - x) ** 2).sqrt()


def _smooth_step(distance: Tensor) -> Tensor:
    """Coverage of a pixel by an area, from the distance to its border."""
    return (distance + 0.5).clamp(0, 1)


def random_start(
    count: int, sigma: float, low: float, high: float, generator: torch.Generator
) -> Tensor:
    """(1, count, 4): Gaussians at random positions of a square, with a third of full brightness."""
    rows = torch.full((1, count, 4), math.log(sigma))
    rows[..., MEAN] = low + (high - low) * torch.rand(1, count, 2, generator=generator)
    rows[..., AMPLITUDE] = 0.3
    return rows
