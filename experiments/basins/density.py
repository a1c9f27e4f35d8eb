"""Rules that add, move and remove Gaussians, with a fixed number of slots for each restart.

They are the rules of 3D Gaussian Splatting, as far as they make sense for a sum of Gaussians: the
amplitude has the role of the opacity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from fit import Population, decay
from targets import AMPLITUDE, LOG_SIGMA, MEAN, Target
from torch import Tensor

#: A Gaussian with a smaller amplitude is dead. The targets have amplitudes of 0.5 to 1.
DEAD = 0.05
_UNTIL = 0.6  # of the steps


@dataclass(frozen=True)
class Changes:
    """When a rule acts.

    Attributes:
        interval: number of steps between two changes.
        count: at each change, at most this number of Gaussians of each restart is changed.
    """

    interval: int = 50
    count: int = 1

    def due(self, step: int, share: float) -> bool:
        """Whether there is a change after this step."""
        return step > 0 and step % self.interval == 0 and share < _UNTIL


@dataclass
class CloneAndSplit:
    """Kerbl et al. 2023: Gaussians with the largest mean |∂L/∂μ| are cloned or split.

    Dead Gaussians are removed, and free slots are filled. A clone is at the same place, with half
    of the amplitude for each, so that the sum is unchanged (the paper keeps the opacity). Both
    separate because the averages of Adam are 0 for the clone.

    Attributes:
        generator: for the positions of children.
        large: a wider Gaussian is split into two, with 1/1.6 of its width.
    """

    generator: torch.Generator
    large: float = 1.0
    changes: Changes = field(default_factory=Changes)
    _sum: Tensor | None = None

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        norm = grad[..., MEAN].norm(dim=-1)
        self._sum = norm if self._sum is None else self._sum + norm
        if not self.changes.due(step, share):
            return
        dead = _dead(population)
        dead[dead.all(dim=1)] = False
        population.alive &= ~dead
        population.parameters[..., AMPLITUDE] *= population.alive
        score, self._sum = self._sum * population.alive, None
        for _ in range(self.changes.count):
            free = ~population.alive
            rows = (free.any(dim=1) & (score > 0).any(dim=1)).nonzero()[:, 0]
            slots, parents = free[rows].int().argmax(dim=1), score[rows].argmax(dim=1)
            score[rows, parents] = 0
            first, second = self._children(population.parameters[rows, parents])
            population.parameters[rows, parents] = first
            population.put(rows, slots, second)

    def _children(self, parents: Tensor) -> tuple[Tensor, Tensor]:
        wide = parents[:, LOG_SIGMA] > math.log(self.large)
        children = []
        for _ in range(2):
            child = parents.clone()
            xi = torch.randn(child[:, MEAN].shape, generator=self.generator, dtype=child.dtype)
            child[:, MEAN] += (child[:, LOG_SIGMA].exp() * wide)[:, None] * xi
            child[:, LOG_SIGMA] -= math.log(1.6) * wide
            child[:, AMPLITUDE] *= torch.where(wide, 1.0, 0.5)
            children.append(child)
        return children[0], children[1]


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
    changes: Changes = field(default_factory=Changes)

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        p = population.parameters
        xi = torch.randn(p[..., MEAN].shape, generator=self.generator, dtype=p.dtype)
        p[..., MEAN] += self.noise * decay(share) * p[..., LOG_SIGMA].exp()[..., None] * xi
        if not self.relocate or not self.changes.due(step, share):
            return
        for _ in range(self.changes.count):
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
        sigma: the width with which a Gaussian begins.
    """

    generator: torch.Generator
    target: Target
    sigma: float = 1.0
    changes: Changes = field(default_factory=Changes)

    def after_step(self, step: int, share: float, population: Population, grad: Tensor) -> None:
        if not self.changes.due(step, share):
            return
        places = self.target.places()
        for _ in range(self.changes.count):
            dead = _dead(population)
            rows = dead.any(dim=1).nonzero()[:, 0]
            if len(rows) == 0:
                return
            slots = dead[rows].int().argmax(dim=1)
            error = self.target.residual(population.parameters)[rows]
            index = _draw(error**2, self.generator)
            amplitude = error.gather(1, index[:, None]) / 2
            log_sigma = torch.full_like(amplitude, math.log(self.sigma))
            population.put(rows, slots, torch.cat([places[index], log_sigma, amplitude], dim=1))


def _dead(population: Population) -> Tensor:
    """(B, K): slots without a Gaussian, or with one that is nearly invisible."""
    return ~population.alive | (population.parameters[..., AMPLITUDE].abs() < DEAD)


def _draw(weights: Tensor, generator: torch.Generator) -> Tensor:
    """(B,): a column of each row of weights (B, W), with a proportional probability."""
    smallest = torch.finfo(weights.dtype).tiny  # all weights may be 0
    return torch.multinomial(weights + smallest, 1, generator=generator)[:, 0]
