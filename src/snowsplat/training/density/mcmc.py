"""Density control as Markov chain Monte Carlo: Kheradmand et al., NeurIPS 2024, "3D Gaussian
Splatting as Markov Chain Monte Carlo".

The Gaussians are samples of a distribution that is high where they explain the photos. Noise in
their positions makes the optimiser explore (stochastic gradient Langevin dynamics, section 3.2);
dead ones are relocated onto live ones in a way that leaves the picture as it was (section 3.3); and
a pull on opacity and scale keeps those alive that are needed, and no more (section 3.4). The number
of Gaussians grows by a fixed share up to a hard cap, so memory is known before the training starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.ops.splats import Splats2D
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, rotation_from_quat
from snowsplat.training.finite import check_parameters
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule, When
from snowsplat.util.errors import SettingError

#: Copies of one Gaussian that a relocation reckons with; more are rare.
MAX_COPIES = 51
#: Sharpness k of the sigmoid that lets noise act on nearly transparent Gaussians alone (eq. 8).
NOISE_SHARPNESS = 100.0
#: Below this share of noise a Gaussian gets none, which spares most of them the random numbers.
NOISE_NEGLIGIBLE = 1e-4


@dataclass(frozen=True)
class McmcDensity:
    """Knobs of MCMC density control; the defaults are those of its paper.

    Attributes:
        densify_from, densify_until: first and last step that may relocate (float: fraction of all
            steps).
        densify_interval: steps between relocations.
        max_gaussians: hard cap, never exceeded.
        growth: how much their number grows at each relocation, until the cap.
        prune_opacity: at or below it a Gaussian is dead, and is relocated.
        noise: of the positions, in units of their learning rate.
        opacity_regularizer, scale_regularizer: weights of the mean opacity and the mean scale in
            the loss.
    """

    densify_from: When = 500
    densify_until: When = 25_000
    densify_interval: int = 100
    max_gaussians: int = 1_000_000
    growth: float = 0.05
    prune_opacity: float = 0.005
    noise: float = 5e5
    opacity_regularizer: float = 0.01
    scale_regularizer: float = 0.01

    def control(
        self,
        count: int,
        *,
        schedule: Schedule,
        extent: float,
        random_start: bool,
        generator: torch.Generator,
        device: torch.device | None = None,
    ) -> McmcDensityControl:
        """Fresh state, which depends on ``schedule`` and ``generator`` alone."""
        if self.max_gaussians <= 0:
            raise SettingError(
                "max_gaussians", "MCMC density control needs a limit; use a positive number"
            )
        return McmcDensityControl(self, schedule, generator)


@dataclass
class McmcDensityControl:
    """State of MCMC density control: its random numbers, which the trainer saves. No statistics."""

    knobs: McmcDensity
    schedule: Schedule
    generator: torch.Generator

    @property
    def first(self) -> int:
        """The first step that may relocate."""
        return self.schedule.step_of(self.knobs.densify_from)

    @property
    def last(self) -> int:
        """The last step that may relocate."""
        return min(self.schedule.step_of(self.knobs.densify_until), self.schedule.iterations)

    def after_backward(
        self,
        step: int,
        gaussians: Gaussians,
        splats: Splats2D,
        width: int,
        height: int,
        valid: Tensor | None = None,
    ) -> None:
        """Add the gradients of λ_o · mean(opacity) and λ_Σ · mean(scale), section 3.4."""
        opacities, scales = gaussians.opacities, gaussians.scales
        opacity_weight = self.knobs.opacity_regularizer / opacities.numel()
        gaussians.opacity_logits.grad = opacity_weight * opacities * (1.0 - opacities)
        gaussians.log_scales.grad = self.knobs.scale_regularizer / scales.numel() * scales

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """Noise at every step; relocation and growth where this step is one that does."""
        self._add_noise(gaussians, optimizer.rates_at(step)["means"])
        if self.first <= step <= self.last and step % self.knobs.densify_interval == 0:
            check_parameters(step, gaussians)
            gaussians = self._relocate(gaussians, optimizer)
        return gaussians

    def _add_noise(self, gaussians: Gaussians, rate: float) -> None:
        """μ += rate · noise · σ(−k (o − t)) · Σ η, η ~ N(0, I), t the opacity of death (eq. 8)."""
        gate = torch.sigmoid(NOISE_SHARPNESS * (self.knobs.prune_opacity - gaussians.opacities))
        if gate.device.type == "cpu":
            rows: Tensor | slice = torch.nonzero(gate > NOISE_NEGLIGIBLE)[:, 0]
            eta = torch.randn(len(gate[rows]), 3, 1, generator=self.generator)
        else:  # noise is cheap there, and to count rows is to wait
            rows = slice(None)
            there = torch.Generator(gate.device)
            there.manual_seed(int(torch.randint(2**62, (), generator=self.generator)))
            eta = torch.randn(len(gate), 3, 1, generator=there, device=gate.device)
        rotations = rotation_from_quat(gaussians.quats[rows])
        # Finite in single precision, whatever the scales are.
        variances = (2.0 * gaussians.log_scales[rows]).clamp(max=40.0).exp()[:, :, None]
        noise = (rotations @ (variances * (rotations.mT @ eta)))[:, :, 0]
        gaussians.means[rows] += rate * self.knobs.noise * gate[rows, None] * noise

    def _relocate(self, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        count = len(gaussians)
        opacities = gaussians.opacities
        survivors = torch.nonzero(opacities > self.knobs.prune_opacity)[:, 0]
        if len(survivors) == 0:
            return gaussians
        grown = min(self.knobs.max_gaussians, int((1.0 + self.knobs.growth) * count))
        moved = max(count, grown) - len(survivors)
        if moved == 0:
            return gaussians
        picks = torch.multinomial(
            opacities[survivors], moved, replacement=True, generator=self.generator
        )
        sources = survivors[picks]
        copies = 1 + torch.bincount(sources, minlength=count)

        index = torch.cat([survivors, sources])
        index = index[morton_order(gaussians.means[index])]
        shared = copies[index] > 1
        gaussians.select_(index)
        new_opacities, shrink = shared_opacity(gaussians.opacities[shared], copies[index][shared])
        new_opacities = new_opacities.clamp(self.knobs.prune_opacity, 1.0 - 1e-6)
        gaussians.opacity_logits[shared] = torch.logit(new_opacities)
        gaussians.log_scales[shared] += shrink.log()[:, None]
        optimizer.select(index, shared)
        return gaussians

    def state_tensors(self) -> dict[str, Tensor]:
        """Nothing."""
        return {}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Nothing to take over."""


def shared_opacity(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """What one Gaussian becomes when N of it lie in one place and look as it did alone (eq. 9).

        o_new = 1 − (1 − o)^(1/N)
        Σ_new = o² (Σ_{i=1..N} Σ_{k=0..i−1} C(i−1, k) (−1)^k o_new^(k+1) / √(k+1))^(−2) Σ

    The sum over i is done first: Σ_i C(i−1, k) = C(N, k+1), which leaves N terms.

    Args:
        opacities: (M,) o.
        copies: (M,) int64 N, the Gaussian itself included; more than 51 are taken as 51.

    Returns:
        o_new (M,) and the factor (M,) of the scales, √(Σ_new / Σ); dtype of ``opacities``.
    """
    copies = copies.clamp(max=MAX_COPIES)
    o = opacities.double().clamp(max=1.0 - 1e-6)
    o_new = -torch.expm1(torch.log1p(-o) / copies)
    binomials = torch.tensor(
        [[math.comb(n, k) for k in range(1, MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)],
        dtype=torch.float64,
    )
    k = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64)
    weights = torch.where(k % 2 == 1, 1.0, -1.0) / k.sqrt()
    # The sum of absolute terms is at most (1 + o_new)^N ~ 5e4 (N = 51, o = 1 − 1e-6): in double
    # precision the cancellation is harmless.
    total = (binomials[copies] * weights * o_new[:, None] ** k).sum(dim=1)
    return o_new.to(opacities), (o / total).to(opacities)
