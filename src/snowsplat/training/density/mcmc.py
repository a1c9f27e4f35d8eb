"""Density control as Markov chain Monte Carlo: Kheradmand et al., NeurIPS 2024, "3D Gaussian
Splatting as Markov Chain Monte Carlo".

The Gaussians are regarded as samples of a distribution whose density is high where they reproduce
the photos. Noise is added to their positions, so that they explore the space (stochastic gradient
Langevin dynamics, section 3.2). Dead Gaussians, which are nearly transparent, are moved to the
positions of other Gaussians such that the rendered image does not change (section 3.3). A
regulariser of opacity and scale makes Gaussians that are not needed disappear (section 3.4). The
number of Gaussians grows by a fixed fraction up to a limit, so the memory is known before training.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, rotation_from_quat
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.settings.density import McmcDensity
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.finite import check_parameters
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient

#: Maximum number of copies of one Gaussian for which eq. 9 is evaluated; larger numbers are rare.
MAX_COPIES = 51
#: Slope k of the sigmoid that restricts noise to nearly transparent Gaussians (eq. 8).
NOISE_SHARPNESS = 100.0
#: Gaussians whose sigmoid is below this value get no noise, so that few random numbers are needed.
NOISE_NEGLIGIBLE = 1e-4
#: λ_Σ of the paper is for scenes of this extent, in world units; COLMAP's have 4 to 6.
USUAL_EXTENT = 5.0


@dataclass
class McmcDensityControl:
    """State of MCMC density control: the random generator, which the trainer saves."""

    settings: McmcDensity
    schedule: Schedule
    extent: float
    generator: torch.Generator
    shards: Shards = ALONE

    @classmethod
    def begin(
        cls,
        settings: McmcDensity,
        count: int,
        *,
        schedule: Schedule,
        extent: float,
        generator: torch.Generator,
        shards: Shards = ALONE,
        **_: object,
    ) -> McmcDensityControl:
        """The initial state; see `density_control`. The other arguments are not used."""
        return cls(settings, schedule, extent, generator, shards)

    @property
    def first(self) -> int:
        """The first step of relocation."""
        return self.schedule.step_of(self.settings.densify_from)

    @property
    def last(self) -> int:
        """The last step of relocation."""
        return min(self.schedule.step_of(self.settings.densify_until), self.schedule.iterations)

    def after_backward(self, step: int, gaussians: Gaussians, gradient: ViewGradient) -> None:
        """Add the gradients of λ_o · mean(opacity) and λ_Σ · mean(scale), section 3.4."""
        opacities, scales = gaussians.opacities, gaussians.scales
        count = self.shards.total(len(gaussians))
        opacity_weight = self.settings.opacity_regularizer / count
        # λ_Σ is relative to the scene; the paper's is per world unit.
        scale_weight = self.settings.scale_regularizer * USUAL_EXTENT / (3 * count * self.extent)
        for parameter, term in (
            (gaussians.opacity_logits, opacity_weight * opacities * (1.0 - opacities)),
            (gaussians.log_scales, scale_weight * scales),
        ):
            parameter.grad = term if parameter.grad is None else parameter.grad + term

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """Add noise; relocate and add Gaussians if the settings require it."""
        if step <= self.schedule.step_of(self.settings.noise_until):
            self._add_noise(gaussians, optimizer.rates_at(step)["means"])
        every = self.settings.densify_interval
        if self.first <= step <= self.last and self.schedule.multiples(step, every):
            check_parameters(step, gaussians)
            gaussians = self._relocate(gaussians, optimizer)
        return gaussians

    def _add_noise(self, gaussians: Gaussians, rate: float) -> None:
        """μ += rate · noise · σ(−k (o − t)) · Σ η, η ~ N(0, I), t = ``prune_opacity`` (eq. 8)."""
        on_cpu = gaussians.means.device.type == "cpu"
        add = self._add_noise_of_generator if on_cpu else self._add_noise_of_rows
        add(gaussians, rate * self.settings.noise)

    def _add_noise_of_rows(self, gaussians: Gaussians, amount: float) -> None:
        """One pass over the rows, with random numbers that depend on the row."""
        ops.add_noise(
            gaussians,
            amount,
            sharpness=NOISE_SHARPNESS,
            opacity=self.settings.prune_opacity,
            negligible=NOISE_NEGLIGIBLE,
            seed=self._seed(),
            first=self.shards.first(len(gaussians)),
        )

    def _add_noise_of_generator(self, gaussians: Gaussians, amount: float) -> None:
        """With the numbers of the generator, of which training runs on a CPU have always had the
        same: their scenes do not change."""
        limit = self.settings.prune_opacity
        gate = torch.sigmoid(NOISE_SHARPNESS * (limit - gaussians.opacities))
        rows = torch.nonzero(gate > NOISE_NEGLIGIBLE)[:, 0]
        first, total = self.shards.first(len(rows)), self.shards.total(len(rows))
        eta = torch.randn(total, 3, 1, generator=self.generator)[first : first + len(rows)]
        rotations = rotation_from_quat(gaussians.quats[rows])
        # With the limit, the variance is finite in single precision for any scale.
        variances = (2.0 * gaussians.log_scales[rows]).clamp(max=40.0).exp()[:, :, None]
        noise = (rotations @ (variances * (rotations.mT @ eta)))[:, :, 0]
        gaussians.means[rows] += amount * gate[rows, None] * noise

    def _relocate(self, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        # The choice depends on all rows. Every process makes it in the same way.
        opacities = self.shards.all_rows(gaussians.opacities)
        count = len(opacities)
        survivors = torch.nonzero(opacities > self.settings.prune_opacity)[:, 0]
        if len(survivors) == 0:
            return gaussians
        grown = min(self.settings.max_gaussians, int((1.0 + self.settings.growth) * count))
        moved = max(count, grown) - len(survivors)
        if moved == 0:
            return gaussians
        sources = survivors[self._drawn(opacities[survivors], moved)]
        copies = 1 + torch.bincount(sources, minlength=count)

        index = torch.cat([survivors, sources])
        index = index[morton_order(self.shards.all_rows(gaussians.means)[index])]
        self.shards.select_(gaussians, index)
        copies = self.shards.own_rows(copies[index])
        shared = copies > 1
        new_opacities, shrink = shared_opacity(gaussians.opacities[shared], copies[shared])
        new_opacities = new_opacities.clamp(self.settings.prune_opacity, 1.0 - 1e-6)
        gaussians.opacity_logits[shared] = torch.logit(new_opacities)
        gaussians.log_scales[shared] += shrink.log()[:, None]
        optimizer.select(index, shared)
        return gaussians

    def _drawn(self, weights: Tensor, count: int) -> Tensor:
        """(count,) int64: positions in ``weights`` (M,) in 0..1, each drawn with its weight."""
        if weights.device.type != "cuda":
            host = weights.cpu()
            drawn = torch.multinomial(host, count, replacement=True, generator=self.generator)
            return drawn.to(weights.device)
        generator = torch.Generator(weights.device)
        generator.manual_seed(self._seed())
        share = torch.rand(count, generator=generator, dtype=torch.float64, device=weights.device)
        return positions_at(weights, share)

    def _seed(self) -> int:
        """The seed of random numbers that are made on a GPU."""
        return int(torch.randint(2**62, (), generator=self.generator))

    def state_tensors(self) -> dict[str, Tensor]:
        """Empty: there are no statistics."""
        return {}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Does nothing: there are no statistics."""


def positions_at(weights: Tensor, share: Tensor) -> Tensor:
    """(S,) int64: the positions in ``weights`` (M,) in 0..1, not all 0, where their cumulative sum
    is the given share (S,) float64 in [0, 1) of the whole sum."""
    # Sums of integers are the same in each process, whatever the order of the additions.
    ends = (2**24 * weights.double()).long().cumsum(0)
    return torch.searchsorted(ends, (share * ends[-1]).long(), right=True)


def shared_opacity(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale of N copies of a Gaussian that together look like the original (eq. 9).

        o_new = 1 − (1 − o)^(1/N)
        Σ_new = o² (Σ_{i=1..N} Σ_{k=0..i−1} C(i−1, k) (−1)^k o_new^(k+1) / √(k+1))^(−2) Σ

    The copies have the same position. The sum over i is evaluated first: Σ_i C(i−1, k) = C(N, k+1),
    so N terms remain.

    Args:
        opacities: (M,) o.
        copies: (M,) int64 N, including the Gaussian itself; clamped to `MAX_COPIES`.

    Returns: o_new (M,) and the factor (M,) of the scales, √(Σ_new / Σ); dtype of ``opacities``.
    """
    copies = copies.clamp(max=MAX_COPIES)
    o = opacities.double().clamp(max=1.0 - 1e-6)
    o_new = -torch.expm1(torch.log1p(-o) / copies)
    binomials = torch.tensor(
        [[math.comb(n, k) for k in range(1, MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)],
        dtype=torch.float64,
        device=o.device,
    )
    k = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=o.device)
    weights = torch.where(k % 2 == 1, 1.0, -1.0) / k.sqrt()
    # The sum of the absolute values is at most (1 + o_new)^N ~ 5e4 (N = 51, o = 1 − 1e-6), so the
    # cancellation is negligible in double precision.
    total = (binomials[copies] * weights * o_new[:, None] ** k).sum(dim=1)
    return o_new.to(opacities), (o / total).to(opacities)
