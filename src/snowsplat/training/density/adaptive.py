"""Adaptive density control, section 5.2 of the paper: clone, split, prune, reset opacity.

A large view-space gradient of the position marks a region that the Gaussians do not represent well
yet. Small Gaussians are cloned there (under-reconstruction), large ones are split in two
(over-reconstruction). Nearly transparent Gaussians are removed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, rotation_from_quat
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.settings.density import AdaptiveDensity
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.finite import check_parameters
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient

#: φ of the paper: a split divides the scale by this factor, which was determined by experiments.
SPLIT_SHRINK = 1.6
#: Largest opacity after a reset.
RESET_OPACITY = 0.01
#: Approximate number of steps that a scene needs to recover from an opacity reset.
RESET_RECOVERY = 500
#: After a reset, Gaussians are removed again when they could have regained the opacity
#: `prune_opacity` in one of this number of steps; not every photo shows every Gaussian.
_STEPS_PER_RECOVERY = 2


@dataclass
class AdaptiveDensityControl:
    """State of adaptive density control."""

    settings: AdaptiveDensity
    schedule: Schedule
    first_reset: bool  # whether opacity is also reset at step ``first``
    extent: float
    generator: torch.Generator
    # (N,) sum over views of |∂L/∂mean2d|, with the image spanning [-1, 1]; if
    # ``settings.abs_grad``, of the norm of the absolute gradients.
    grad_sum: Tensor
    views: Tensor  # (N,) number of views in this sum: those in which the Gaussian was visible
    max_radii: Tensor  # (N,) largest 3σ radius in these views, in pixels
    shards: Shards = ALONE  # the processes; N is the number of rows of this process

    @classmethod
    def begin(
        cls,
        settings: AdaptiveDensity,
        count: int,
        *,
        schedule: Schedule,
        extent: float,
        random_init: bool,
        generator: torch.Generator,
        device: torch.device | None = None,
        shards: Shards = ALONE,
    ) -> AdaptiveDensityControl:
        """The initial state; see `density_control`."""
        return cls(
            settings=settings,
            schedule=schedule,
            first_reset=settings.reset_random_start and random_init,
            extent=extent,
            generator=generator,
            grad_sum=torch.zeros(count, device=device),
            views=torch.zeros(count, device=device),
            max_radii=torch.zeros(count, device=device),
            shards=shards,
        )

    @property
    def first(self) -> int:
        """The first step of densification."""
        return self.schedule.step_of(self.settings.densify_from)

    @property
    def last(self) -> int:
        """The last step of densification."""
        return min(self.schedule.step_of(self.settings.densify_until), self.schedule.iterations)

    def after_backward(self, step: int, gaussians: Gaussians, gradient: ViewGradient) -> None:
        """Accumulate the statistics of the Gaussians that are visible in this view."""
        if step > self.last:
            return
        max_radii = self.max_radii if self.settings.prune_screen_size > 0 else None
        gradient.add_statistics(
            self.grad_sum, self.views, max_radii, absolute=self.settings.abs_grad
        )

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """Densify, prune or reset opacity, if the settings require it at ``step``."""
        every = self.settings.densify_interval
        if self.first <= step <= self.last and self.schedule.multiples(step, every):
            check_parameters(step, gaussians)
            gaussians = self._refine(step, gaussians, optimizer)
        if self._resets_at(step):
            limit = math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))
            gaussians.opacity_logits.clamp_(max=limit)
            optimizer.zero("opacity_logits")
        return gaussians

    def _resets_at(self, step: int) -> bool:
        if self.first_reset and self.schedule.contains(step, (self.first,)):
            return step <= self.schedule.iterations - RESET_RECOVERY
        every = self.settings.opacity_reset_interval
        if every <= 0 or step > self.last - RESET_RECOVERY:
            return False
        return self.schedule.multiples(step, every) > 0

    def _recovers(self, step: int, optimizer: Adam) -> bool:
        """Whether the last reset is so recent that no opacity can be `prune_opacity` again.

        A step of Adam changes a logit by about its learning rate.
        """
        prune = self.settings.prune_opacity
        if prune <= RESET_OPACITY:
            return False
        change = math.log(prune / (1.0 - prune)) - math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))
        rate = optimizer.rates_at(step)["opacity_logits"]
        steps = math.ceil(_STEPS_PER_RECOVERY * change / rate) if rate > 0.0 else step
        return any(self._resets_at(each) for each in range(max(1, step - steps + 1), step))

    def _refine(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        settings, shards = self.settings, self.shards
        # The choice depends on all rows. Every process makes it in the same way.
        grads = shards.all_rows(self.grad_sum / self.views.clamp_min(1.0))
        size = shards.all_rows(gaussians.log_scales.amax(dim=1).exp() / self.extent)
        alive = shards.all_rows(gaussians.opacities) >= settings.prune_opacity
        if not bool(alive.any()) or self._recovers(step, optimizer):
            alive = torch.ones_like(alive)
        dense = self._densified(grads, alive)
        split = dense & (size > settings.percent_dense)

        # A split Gaussian is replaced with two children. A cloned Gaussian remains and gets a copy.
        # Children and copies start with zero moments. So the moments of a copy and of its original
        # are different, and the two move apart.
        kept = alive & ~split
        large = torch.zeros_like(alive)
        prunes_by_size = 0 < settings.opacity_reset_interval < step
        if prunes_by_size and settings.prune_world_size > 0:
            large |= torch.where(split, size / SPLIT_SHRINK, size) > settings.prune_world_size
        if prunes_by_size and settings.prune_screen_size > 0:
            large |= kept & (shards.all_rows(self.max_radii) > settings.prune_screen_size)
        kept, clones, parents = (
            torch.nonzero(rows & ~large)[:, 0] for rows in (kept, dense & ~split, split)
        )
        index = torch.cat([kept, clones, parents, parents])
        row = torch.arange(len(index), device=index.device)
        fresh, child = row >= len(kept), row >= len(kept) + len(clones)

        means = shards.all_rows(gaussians.means)[index]
        means[child] += self._offsets(gaussians, index[child])
        order = morton_order(means)
        index, fresh, child = index[order], fresh[order], child[order]
        optimizer.select(index, shards.own_rows(fresh))
        shards.select_(gaussians, index)
        gaussians.means = shards.own_rows(means[order])
        gaussians.log_scales[shards.own_rows(child)] -= math.log(SPLIT_SHRINK)
        for name, tensor in self.state_tensors().items():
            setattr(self, name, tensor.new_zeros(len(gaussians)))
        return gaussians

    def _densified(self, grads: Tensor, alive: Tensor) -> Tensor:
        """The rows to clone or split, (N,) bool. Each of these rows adds one Gaussian.

        There are at most as many of them as ``max_gaussians`` permits.

        Args:
            grads: (N,) mean norm of the view-space position gradient.
            alive: (N,) bool: rows whose opacity is at least ``prune_opacity``.
        """
        dense = alive & (grads > self.settings.grad_threshold)
        if self.settings.max_gaussians > 0:
            remaining = max(0, self.settings.max_gaussians - int(alive.sum()))
            candidates = torch.nonzero(dense)[:, 0]
            order = torch.argsort(grads[candidates], descending=True, stable=True)
            dense[candidates[order[remaining:]]] = False
        return dense

    def _offsets(self, gaussians: Gaussians, parents: Tensor) -> Tensor:
        """Samples (M, 3) of N(0, Σ) of the rows ``parents`` (M,): R S ε, in world units."""
        scales = self.shards.all_rows(gaussians.log_scales)[parents].exp()
        offsets = scales * torch.randn(scales.shape, generator=self.generator).to(scales)
        rotations = rotation_from_quat(self.shards.all_rows(gaussians.quats)[parents])
        return (rotations @ offsets[:, :, None])[:, :, 0]

    def state_tensors(self) -> dict[str, Tensor]:
        """The statistics, by name. The tensors are not copied."""
        return {"grad_sum": self.grad_sum, "views": self.views, "max_radii": self.max_radii}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""
        for name, tensor in self.state_tensors().items():
            setattr(self, name, tensors[name].to(tensor.device, copy=True))
