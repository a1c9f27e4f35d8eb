"""Rules that add, move and remove Gaussians, with a fixed number of slots for each restart.

The rules are those of 3D Gaussian Splatting, as far as they make sense for a sum of Gaussians on a
line: the amplitude has the role of the opacity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from fit import Population
from targets import AMPLITUDE, LOG_SIGMA, MEAN, Target, evaluate
from torch import Tensor

#: A Gaussian with a smaller amplitude is dead. Targets have amplitudes of 0.5 to 1.
DEAD = 0.05
#: Number of steps between two changes, and the part of the steps in which there are changes.
_INTERVAL = 50
_UNTIL = 0.6


def _due(step: int, share: float) -> bool:
    return step > 0 and step % _INTERVAL == 0 and share < _UNTIL


def _dead(population: Population) -> Tensor:
    """(B, K): slots without a Gaussian, or with one that is nearly invisible."""
    return ~population.alive | (population.parameters[..., AMPLITUDE].abs() < DEAD)


def _draw(weights: Tensor, generator: torch.Generator) -> Tensor:
    """(B,): a column of each row of weights (B, W), with a proportional probability."""
    return torch.multinomial(weights + 1e-300, 1, generator=generator)[:, 0]


@dataclass
class CloneAndSplit:
    """Kerbl et al. 2023: the Gaussian with the largest mean |∂L/∂μ| is cloned or split.

    Dead Gaussians are removed. At each change, a restart with a free slot gets one more Gaussian.
    A clone is at the same place. Both have half of the amplitude, so that the sum is unchanged (the
    paper keeps the opacity), and they separate because the averages of Adam are 0 for the clone.

    Attributes:
        generator: for the positions of children.
        large: a Gaussian that is wider than this is split into two, of 1/1.6 of its width.
    """

    generator: torch.Generator
    large: float = 1.0
    _sum: Tensor | None = None

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        size = grad[..., MEAN].abs()
        self._sum = size if self._sum is None else self._sum + size
        if not _due(step, share):
            return
        dead = _dead(population)
        dead[dead.all(dim=1)] = ~population.alive[dead.all(dim=1)]  # the last ones stay
        population.alive &= ~dead
        population.parameters[..., AMPLITUDE] *= population.alive
        rows = (~population.alive).any(dim=1).nonzero()[:, 0]
        slots = (~population.alive[rows]).int().argmax(dim=1)
        parents = (self._sum * population.alive)[rows].argmax(dim=1)
        self._sum = None
        child = population.parameters[rows, parents]
        wide = child[:, LOG_SIGMA] > math.log(self.large)
        offsets = torch.randn(2, len(rows), generator=self.generator, dtype=child.dtype)
        offsets *= child[:, LOG_SIGMA].exp() * wide
        shrink = math.log(1.6) * wide
        share_of_amplitude = torch.where(wide, 1.0, 0.5)
        pair = []
        for offset in offsets:
            mean, log_sigma, amplitude = child.unbind(dim=1)
            columns = [mean + offset, log_sigma - shrink, amplitude * share_of_amplitude]
            pair.append(torch.stack(columns, dim=1))
        population.parameters[rows, parents] = pair[0]
        population.put(rows, slots, pair[1])


@dataclass
class Mcmc:
    """Kheradmand et al. 2024: noise on the positions; dead Gaussians move to other ones.

    The place is drawn with a probability proportional to the amplitude, and both Gaussians there
    get half of it. The noise is proportional to the width, and decreases as the learning rate.

    Attributes:
        generator: of the noise and of the places.
        noise: standard deviation of the noise in the first step, in units of the width.
        relocate: False: only noise.
    """

    generator: torch.Generator
    noise: float
    relocate: bool = True

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        p = population.parameters
        amount = self.noise * (0.5 + 0.5 * math.cos(math.pi * share))
        xi = torch.randn(p.shape[:2], generator=self.generator, dtype=p.dtype)
        p[..., MEAN] += amount * p[..., LOG_SIGMA].exp() * xi
        if not self.relocate or not _due(step, share):
            return
        dead = _dead(population)
        rows = (dead.any(dim=1) & ~dead.all(dim=1)).nonzero()[:, 0]
        slots = dead[rows].int().argmax(dim=1)
        parents = _draw(p[rows, :, AMPLITUDE].abs() * ~dead[rows], self.generator)
        p[rows, parents, AMPLITUDE] /= 2
        population.put(rows, slots, p[rows, parents])


@dataclass
class Refill:
    """Error-driven refill: a dead Gaussian moves to a place that is drawn from the squared error.

    It begins with half of the error there.

    Attributes:
        generator: of the places.
        target: the signal.
        x: (P,) the positions that are drawn.
        sigma: the width with which a Gaussian begins.
    """

    generator: torch.Generator
    target: Target
    x: Tensor
    sigma: float = 1.0

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        if not _due(step, share):
            return
        dead = _dead(population)
        rows = dead.any(dim=1).nonzero()[:, 0]
        slots = dead[rows].int().argmax(dim=1)
        error = (self.target.value(self.x) - evaluate(population.parameters, self.x))[rows]
        place = _draw(error**2, self.generator)
        amplitude = error.gather(1, place[:, None])[:, 0] / 2
        columns = [self.x[place], torch.full_like(amplitude, math.log(self.sigma)), amplitude]
        population.put(rows, slots, torch.stack(columns, dim=1))
