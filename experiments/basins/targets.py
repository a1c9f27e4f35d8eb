"""Signals on a line, as functions whose overlap with a Gaussian is known in closed form.

The loss of a sum of Gaussians, ½ ∫ (model − target)² dx, then needs no grid, and has no border.
Tensors have B rows, one for each restart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

# Columns of the parameters (B, K, 3) of K Gaussians.
MEAN, LOG_SIGMA, AMPLITUDE = range(3)


def pair_overlap(d2: Tensor, var: Tensor, other_var: Tensor, n: int = 1) -> Tensor:
    """∫ of the product of two isotropic Gaussians, from d² and both variances."""
    total = var + other_var
    return (2 * math.pi * var * other_var / total) ** (n / 2) * torch.exp(-d2 / (2 * total))


class Target(Protocol):
    """A signal for each restart."""

    def energy(self) -> Tensor:
        """(B,): ∫ target² dx, without blur."""

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        """(B, K): ∫ of the product with exp(−(x − mean)² / 2 var), if the target is blurred."""

    def value(self, x: Tensor) -> Tensor:
        """(B, P): the signal at the positions x (P,), without blur."""


@dataclass(frozen=True)
class Mixture:
    """A sum of M Gaussians in n dimensions, all of them on the first axis.

    Attributes:
        parameters: (B, M, 3) or (1, M, 3), as those of the model.
        n: number of dimensions.
    """

    parameters: Tensor
    n: int = 1

    def energy(self) -> Tensor:
        mean, var, amplitude = split(self.parameters)
        return (amplitude * self.overlap(mean, var, 0.0)).sum(1)

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        t_mean, t_var, amplitude = split(self.parameters)
        if blur:  # a wider and lower Gaussian with the same integral
            wide = t_var + blur**2
            t_var, amplitude = wide, amplitude * (t_var / wide) ** (self.n / 2)
        d2 = (mean[:, :, None] - t_mean[:, None, :]) ** 2
        pairs = pair_overlap(d2, var[:, :, None], t_var[:, None, :], self.n)
        return (pairs * amplitude[:, None, :]).sum(2)

    def value(self, x: Tensor) -> Tensor:
        return evaluate(self.parameters, x)


@dataclass(frozen=True)
class Box:
    """1 between two step edges, 0 elsewhere (one dimension).

    Attributes:
        low, high: (B,) the positions of the edges.
    """

    low: Tensor
    high: Tensor

    def energy(self) -> Tensor:
        return self.high - self.low

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        # Blurring the target or the Gaussian gives the same product.
        wide = var + blur**2
        height = (var / wide).sqrt()

        def below(edge: Tensor) -> Tensor:
            return torch.erf((edge[:, None] - mean) / (2 * wide).sqrt())

        area = (math.pi * wide / 2).sqrt() * (below(self.high) - below(self.low))
        return height * area

    def value(self, x: Tensor) -> Tensor:
        return ((x >= self.low[:, None]) & (x <= self.high[:, None])).to(x)


def split(parameters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and amplitude, each (B, K)."""
    mean, log_sigma, amplitude = parameters.unbind(dim=2)
    return mean, torch.exp(2 * log_sigma), amplitude


def evaluate(parameters: Tensor, x: Tensor) -> Tensor:
    """(B, P): the sum of the Gaussians (B, K, 3) at the positions x (P,)."""
    mean, var, amplitude = split(parameters)
    d2 = (x[None, None, :] - mean[:, :, None]) ** 2
    return (amplitude[:, :, None] * torch.exp(-d2 / (2 * var[:, :, None]))).sum(1)


def cross_term(parameters: Tensor, target: Target, blur: float, n: int) -> Tensor:
    """(B,): the loss without the constant ½ ∫ target² dx."""
    mean, var, amplitude = split(parameters)
    d2 = (mean[:, :, None] - mean[:, None, :]) ** 2
    own = pair_overlap(d2, var[:, :, None], var[:, None, :], n)
    own = (own * amplitude[:, :, None] * amplitude[:, None, :]).sum((1, 2)) / 2
    return own - (amplitude * target.overlap(mean, var, blur)).sum(1)


@torch.no_grad()
def relative_error(parameters: Tensor, target: Target, n: int = 1) -> Tensor:
    """(B,): ∫ (model − target)² dx / ∫ target² dx; infinite if a parameter is not finite."""
    energy = target.energy()
    error = 1 + 2 * cross_term(parameters, target, 0.0, n) / energy
    return torch.where(error.isfinite(), error, torch.inf)
