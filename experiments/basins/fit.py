"""Fits of many restarts at once, by gradient descent, momentum or Adam."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from targets import AMPLITUDE, LOG_SIGMA, MEAN, Target
from torch import Tensor

_MOMENTUM = 0.9
_BETAS = (0.9, 0.999)
_BLUR_UNTIL = 0.6  # of the steps
_SIGMAS = (0.02, 200.0)


@dataclass(frozen=True)
class Options:
    """Settings of a fit.

    Attributes:
        optimizer: "gradient descent", "momentum" or "Adam".
        rate: learning rate of log σ and of the amplitude at the first step; see `decay`.
        unit: the rate of the positions is `rate` times this length, a typical width.
        steps: number of steps.
        only_means: the widths and the amplitudes do not change.
        blur: standard deviation by which the target is blurred in the first step. It decreases
            linearly to 0 in the first 60% of the steps.
        eps: ε of Adam.
        gradient_noise: standard deviation of the noise that each step adds to each gradient.
    """

    optimizer: str = "Adam"
    rate: float = 0.1
    unit: float = 1.0
    steps: int = 1000
    only_means: bool = False
    blur: float = 0.0
    eps: float = 1e-15
    gradient_noise: float = 0.0


@dataclass
class Population:
    """The Gaussians of all restarts, and the state of the optimiser.

    Attributes:
        parameters: (B, K, C).
        alive: (B, K) bool. The others have the amplitude 0 and do not change.
        first, second: (B, K, C) the running averages of the gradient and of its square.
    """

    parameters: Tensor
    alive: Tensor
    first: Tensor = field(init=False)
    second: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.parameters = self.parameters.clone()
        self.parameters[..., AMPLITUDE] *= self.alive
        self.first = torch.zeros_like(self.parameters)
        self.second = torch.zeros_like(self.parameters)

    def put(self, rows: Tensor, slots: Tensor, values: Tensor) -> None:
        """New Gaussians (R, C), alive and with averages of 0, in `slots` of `rows`, each (R,)."""
        self.parameters[rows, slots] = values
        self.alive[rows, slots] = True
        self.first[rows, slots] = 0
        self.second[rows, slots] = 0


class DensityControl(Protocol):
    """Changes the population after each step."""

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        """`share`: the part of the steps that is done; `grad`: (B, K, C) of this step."""


def decay(share: float) -> float:
    """The factor of learning rates and noise: from 1 to 0 with half a period of a cosine."""
    return 0.5 + 0.5 * math.cos(math.pi * share)


def fit(
    start: Tensor,
    target: Target,
    options: Options,
    *,
    alive: Tensor | None = None,
    density: DensityControl | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The parameters (B, K, C) at the end, in the dtype of `start`.

    Args:
        start: (B, K, C) the parameters at the beginning.
        alive: (B, K) bool: the Gaussians of the start; by default all.
        generator: of the noise of the gradient.
    """
    if alive is None:
        alive = torch.ones(start.shape[:2], dtype=torch.bool)
    population = Population(start, alive)
    for step in range(options.steps):
        share = step / options.steps
        blur = options.blur * max(0.0, 1 - share / _BLUR_UNTIL)
        p = population.parameters.detach().requires_grad_()
        grad = torch.autograd.grad(target.loss(p, blur).sum(), p)[0]
        if options.gradient_noise:
            noise = torch.randn(grad.shape, generator=generator, dtype=grad.dtype)
            grad = grad + options.gradient_noise * noise
        if options.only_means:
            grad[..., LOG_SIGMA:] = 0
        grad *= population.alive[..., None]
        change = _change(population, grad, options, step + 1)
        change[..., MEAN] *= options.unit
        population.parameters.sub_(options.rate * decay(share) * change)
        population.parameters[..., LOG_SIGMA].clamp_(*map(math.log, _SIGMAS))
        if density is not None:
            density.after_step(step, share, population, grad)
    return population.parameters


def _change(population: Population, grad: Tensor, options: Options, count: int) -> Tensor:
    """(B, K, C): the step divided by −rate; updates the averages."""
    if options.optimizer == "Adam":
        beta1, beta2 = _BETAS
        population.first.lerp_(grad, 1 - beta1)
        population.second.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        scale = (population.second / (1 - beta2**count)).sqrt_().add_(options.eps)
        return (population.first / (1 - beta1**count)).div_(scale)
    if options.optimizer == "momentum":
        population.first.mul_(_MOMENTUM).add_(grad)
        return population.first.clone()
    return grad
