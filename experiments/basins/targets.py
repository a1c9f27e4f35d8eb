"""Signals on a line, as functions whose overlap with a Gaussian is known in closed form.

The loss of a sum of Gaussians, ½ ∫ (model − target)² dx, then needs no grid, and has no border.
Tensors have B rows, one for each restart.

The columns of a Gaussian are its mean (one column on a line, two in an image), log σ, amplitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

MEAN, LOG_SIGMA, AMPLITUDE = slice(0, -2), -2, -1


class Target(Protocol):
    """A signal for each restart, and the loss of a model (B, K, C)."""

    def loss(self, parameters: Tensor, blur: float) -> Tensor:
        """(B,): ½ ∫ (model − target)² dx without terms that do not depend on the model.

        The target is blurred by a Gaussian with the standard deviation `blur`.
        """

    def relative_error(self, parameters: Tensor) -> Tensor:
        """(B,): ∫ (model − target)² dx / ∫ target² dx; infinite for a diverged model."""

    def places(self) -> Tensor:
        """(P, D): positions on a grid."""

    def residual(self, parameters: Tensor) -> Tensor:
        """(B, P): target − model at these positions."""


@dataclass(frozen=True)
class _OnALine:
    """What the signals on a line have in common.

    Attributes:
        domain: the interval in which `places` are.
    """

    domain: tuple[float, float]

    def energy(self) -> Tensor:
        """(B,): ∫ target² dx."""
        raise NotImplementedError

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        """(B, K): ∫ of the blurred target times exp(−(x − mean)² / 2 var)."""
        raise NotImplementedError

    def value(self, x: Tensor) -> Tensor:
        """(B, P): the signal at the positions x (P,)."""
        raise NotImplementedError

    @property
    def dimensions(self) -> int:
        return 1

    def loss(self, parameters: Tensor, blur: float) -> Tensor:
        mean, var, amplitude = columns(parameters)
        own = _pairs(mean, var, mean, var, self.dimensions)
        own = (own * amplitude[:, :, None] * amplitude[:, None, :]).sum((1, 2)) / 2
        return own - (amplitude * self.overlap(mean, var, blur)).sum(1)

    @torch.no_grad()
    def relative_error(self, parameters: Tensor) -> Tensor:
        error = 1 + 2 * self.loss(parameters, 0.0) / self.energy()
        return torch.where(error.isfinite(), error, torch.inf)

    def places(self) -> Tensor:
        return torch.linspace(*self.domain, 400, dtype=torch.float64)[:, None]

    def residual(self, parameters: Tensor) -> Tensor:
        x = self.places()[:, 0]
        return self.value(x) - evaluate(parameters, x)


@dataclass(frozen=True)
class Mixture(_OnALine):
    """A sum of M Gaussians in `n` dimensions, all of them on the first axis.

    Attributes:
        parameters: (B, M, 3) or (1, M, 3), as those of the model.
        n: number of dimensions.
    """

    parameters: Tensor
    n: int = 1

    @property
    def dimensions(self) -> int:
        return self.n

    def energy(self) -> Tensor:
        mean, var, amplitude = columns(self.parameters)
        return (amplitude * self.overlap(mean, var, 0.0)).sum(1)

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        target_mean, target_var, amplitude = columns(self.parameters)
        wide = target_var + blur**2  # a wider and lower Gaussian with the same integral
        amplitude = amplitude * (target_var / wide) ** (self.n / 2)
        return (_pairs(mean, var, target_mean, wide, self.n) * amplitude[:, None, :]).sum(2)

    def value(self, x: Tensor) -> Tensor:
        return evaluate(self.parameters, x)


@dataclass(frozen=True)
class Box(_OnALine):
    """1 between two step edges, 0 elsewhere.

    Attributes:
        low, high: (B,) the positions of the edges.
    """

    low: Tensor
    high: Tensor

    def energy(self) -> Tensor:
        return self.high - self.low

    def overlap(self, mean: Tensor, var: Tensor, blur: float) -> Tensor:
        # It makes no difference whether the target or the Gaussian is blurred.
        wide = var + blur**2
        scale = (2 * wide).sqrt()
        sides = [torch.erf((edge[:, None] - mean) / scale) for edge in (self.low, self.high)]
        return (math.pi * var / 2).sqrt() * (sides[1] - sides[0])

    def value(self, x: Tensor) -> Tensor:
        return ((x >= self.low[:, None]) & (x <= self.high[:, None])).to(x)


def columns(parameters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and amplitude of Gaussians on a line, each (B, K)."""
    mean, log_sigma, amplitude = parameters.unbind(dim=2)
    return mean, torch.exp(2 * log_sigma), amplitude


def evaluate(parameters: Tensor, x: Tensor) -> Tensor:
    """(B, P): the sum of the Gaussians (B, K, 3) at the positions x (P,)."""
    mean, var, amplitude = columns(parameters)
    d2 = (x[None, None, :] - mean[:, :, None]) ** 2
    return (amplitude[:, :, None] * torch.exp(-d2 / (2 * var[:, :, None]))).sum(1)


def _pairs(mean: Tensor, var: Tensor, other_mean: Tensor, other_var: Tensor, n: int) -> Tensor:
    """(B, K, M): ∫ of the product of two Gaussians with amplitude 1 (`closed_form.overlap`)."""
    var, other_var = var[:, :, None], other_var[:, None, :]
    total = var + other_var
    d2 = (mean[:, :, None] - other_mean[:, None, :]) ** 2
    return (2 * math.pi * var * other_var / total) ** (n / 2) * torch.exp(-d2 / (2 * total))
