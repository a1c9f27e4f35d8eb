"""Fits of many restarts at once, by gradient descent, momentum or Adam."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from targets import AMPLITUDE, LOG_SIGMA, MEAN, Target, cross_term
from torch import Tensor

_MOMENTUM = 0.9
_BETAS = (0.9, 0.999)
_LOG_SIGMAS = (math.log(0.02), math.log(200.0))


@dataclass(frozen=True)
class Options:
    """Settings of a fit.

    Attributes:
        optimizer: "gradient descent", "momentum" or "Adam".
        rate: learning rate at the first step. It decreases to 0 with half a period of a cosine.
            One rate for all parameters: positions in units of the width of a typical target, log σ,
            and amplitudes in units of its amplitude.
        steps: number of steps.
        learned: the columns that change.
        blur: standard deviation by which the target is blurred in the first step. It decreases
            linearly to 0 in the first 60% of the steps.
        eps: ε of Adam.
        gradient_noise: standard deviation of the noise that each step adds to each gradient.
        n: number of dimensions.
    """

    optimizer: str = "Adam"
    rate: float = 0.03
    steps: int = 1000
    learned: tuple[int, ...] = (MEAN, LOG_SIGMA, AMPLITUDE)
    blur: float = 0.0
    eps: float = 1e-15
    gradient_noise: float = 0.0
    n: int = 1


@dataclass
class Population:
    """The Gaussians of all restarts, and the state of the optimiser.

    Attributes:
        parameters: (B, K, 3).
        alive: (B, K) bool. The others have the amplitude 0 and do not change.
        first, second: (B, K, 3) the running averages of the gradient and of its square.
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
        """New Gaussians (R, 3), alive and with averages of 0, in `slots` of `rows`, each (R,)."""
        self.parameters[rows, slots] = values
        self.alive[rows, slots] = True
        self.first[rows, slots] = 0
        self.second[rows, slots] = 0


class DensityControl(Protocol):
    """Changes the population after each step."""

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        """`share`: the part of the steps that is done; `grad`: (B, K, 3) of this step."""


def fit(
    start: Tensor,
    target: Target,
    options: Options,
    *,
    alive: Tensor | None = None,
    density: DensityControl | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The parameters (B, K, 3) at the end; the dtype is that of `start`."""
    if alive is None:
        alive = torch.ones(start.shape[:2], dtype=torch.bool)
    population = Population(start, alive)
    learned = torch.zeros(3, dtype=start.dtype)
    learned[list(options.learned)] = 1
    for step in range(options.steps):
        share = step / options.steps
        blur = options.blur * max(0.0, 1 - share / 0.6)
        p = population.parameters.detach().requires_grad_()
        value = cross_term(p, target, blur, options.n).sum()
        grad = torch.autograd.grad(value, p)[0]
        grad *= learned * population.alive[..., None]
        if options.gradient_noise:
            noise = torch.randn(grad.shape, generator=generator, dtype=grad.dtype)
            grad += options.gradient_noise * noise * learned
        rate = options.rate * (0.5 + 0.5 * math.cos(math.pi * share))
        _update(population, grad, rate, options, step + 1)
        population.parameters[..., LOG_SIGMA].clamp_(*_LOG_SIGMAS)
        if density is not None:
            density.after_step(step, share, population, grad)
    return population.parameters


def _update(
    population: Population, grad: Tensor, rate: float, options: Options, count: int
) -> None:
    if options.optimizer == "Adam":
        beta1, beta2 = _BETAS
        population.first.lerp_(grad, 1 - beta1)
        population.second.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        scale = (population.second / (1 - beta2**count)).sqrt_().add_(options.eps)
        population.parameters.addcdiv_(population.first / (1 - beta1**count), scale, value=-rate)
    elif options.optimizer == "momentum":
        population.first.mul_(_MOMENTUM).add_(grad)
        population.parameters.sub_(rate * population.first)
    else:
        population.parameters.sub_(rate * grad)
