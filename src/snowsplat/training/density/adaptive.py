"""Adaptive density control, the paper's own (section 5.2): clone, split, prune, reset opacity.

Gaussians that are pulled about on the screen (a large view-space gradient of their position) lie
where the scene is not yet well described. Small ones there are cloned, since something is missing;
large ones are split in two, since they cover too much. Nearly transparent ones are removed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, rotation_from_quat
from snowsplat.training.finite import check_parameters
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule, When

#: A split child is smaller than its parent by this (the paper's φ, found by experiment).
SPLIT_SHRINK = 1.6
#: What the opacity reset leaves at most.
RESET_OPACITY = 0.01
#: Steps that a scene needs to recover from an opacity reset.
RESET_RECOVERY = 500


@dataclass(frozen=True)
class AdaptiveDensity:
    """Knobs of adaptive density control; the defaults are the paper's.

    Attributes:
        densify_from, densify_until: first and last step that may densify (float: fraction of all
            steps).
        densify_interval: steps between densifications.
        grad_threshold: mean norm of the view-space position gradient above which a Gaussian is
            densified.
        percent_dense: the larger scale up to which a Gaussian is cloned rather than split, in
            extents.
        prune_opacity: Gaussians below it are removed.
        prune_world_size: those with a larger scale, in extents, are removed; 0 is off. It destroys
            forward-facing scenes, whose extent is small beside their depth.
        prune_screen_size: those with a larger 3σ radius, in pixels, are removed; 0 is off.
            Pruning by either size begins after the first opacity reset.
        opacity_reset_interval: steps between opacity resets; 0 is none. The last is at least 500
            steps before densification ends.
        reset_random_start: where training began with random points, also reset opacity at
            ``densify_from``, unless fewer than 500 steps are left. Most random points lie in empty
            space, where they learn to look like the background rather than to vanish: without the
            reset 100,000 of them can end as a cloud of its colour.
        max_gaussians: hard cap; where it leaves too little room, the largest gradients go first. 0
            is none.
    """

    densify_from: When = 500
    densify_until: When = 15_000
    densify_interval: int = 100
    grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    prune_world_size: float = 0.1
    prune_screen_size: float = 20.0
    opacity_reset_interval: int = 3000
    reset_random_start: bool = True
    max_gaussians: int = 0

    def control(
        self,
        count: int,
        *,
        schedule: Schedule,
        extent: float,
        random_start: bool,
        generator: torch.Generator,
        device: torch.device | None = None,
    ) -> AdaptiveDensityControl:
        """Fresh state for ``count`` Gaussians in a scene of ``extent`` world units."""
        return AdaptiveDensityControl(
            knobs=self,
            schedule=schedule,
            first_reset=self.reset_random_start and random_start,
            extent=extent,
            generator=generator,
            grad_sum=torch.zeros(count, device=device),
            views=torch.zeros(count, device=device),
            max_radii=torch.zeros(count, device=device),
        )


@dataclass
class AdaptiveDensityControl:
    """State of adaptive density control.

    Attributes:
        first_reset: whether ``first`` resets opacity too.
        grad_sum: (N,) sum over views of the norm of the position gradient, in half image sizes.
        views: (N,) number of views in that sum: those in which the Gaussian was visible.
        max_radii: (N,) largest 3σ radius seen, in pixels.
    """

    knobs: AdaptiveDensity
    schedule: Schedule
    first_reset: bool
    extent: float
    generator: torch.Generator
    grad_sum: Tensor
    views: Tensor
    max_radii: Tensor

    @property
    def first(self) -> int:
        """The first step that may densify."""
        return self.schedule.step_of(self.knobs.densify_from)

    @property
    def last(self) -> int:
        """The last step that may densify."""
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
        """Accumulate the statistics of the Gaussians that this view sees."""
        if step > self.last:
            return
        radii = self.max_radii if self.knobs.prune_screen_size > 0 else None
        ops.accumulate_screen_statistics(
            splats, width, height, self.grad_sum, self.views, radii, valid
        )

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """Densify, prune and reset where this step is one that does."""
        knobs = self.knobs
        if self.first <= step <= self.last and step % knobs.densify_interval == 0:
            check_parameters(step, gaussians)
            gaussians = self._refine(step, gaussians, optimizer)
        if self._resets_at(step):
            limit = math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))
            gaussians.opacity_logits.clamp_(max=limit)
            optimizer.zero("opacity_logits")
        return gaussians

    def _resets_at(self, step: int) -> bool:
        if self.first_reset and step == self.first:
            return step <= self.schedule.iterations - RESET_RECOVERY
        every = self.knobs.opacity_reset_interval
        return every > 0 and step % every == 0 and step <= self.last - RESET_RECOVERY

    def _refine(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        knobs = self.knobs
        grads = self.grad_sum / self.views.clamp_min(1.0)
        size = gaussians.log_scales.amax(dim=1).exp() / self.extent
        alive = gaussians.opacities >= knobs.prune_opacity
        dense = self._densified(grads, alive)
        split = dense & (size > knobs.percent_dense)
        # A split parent makes way for two children; every other survivor stays as it is, and a
        # cloned one gets a twin. Children and twins start without momentum, which is what drives a
        # twin and its original apart.
        kept = alive & ~split
        large = torch.zeros_like(alive)
        after_first_reset = 0 < knobs.opacity_reset_interval < step
        if after_first_reset and knobs.prune_world_size > 0:
            large |= torch.where(split, size / SPLIT_SHRINK, size) > knobs.prune_world_size
        if after_first_reset and knobs.prune_screen_size > 0:
            large |= kept & (self.max_radii > knobs.prune_screen_size)
        kept, clones, parents = (
            torch.nonzero(rows & ~large)[:, 0] for rows in (kept, dense & ~split, split)
        )

        index = torch.cat([kept, clones, parents, parents])
        row = torch.arange(len(index), device=index.device)
        fresh, child = row >= len(kept), row >= len(kept) + len(clones)
        means = gaussians.means[index]
        means[child] += self._offsets(gaussians, index[child])

        order = morton_order(means)
        index, fresh, child = index[order], fresh[order], child[order]
        optimizer.select(index, fresh)
        for name, tensor in self.state_tensors().items():
            setattr(self, name, tensor.new_zeros(len(index)))
        gaussians.select_(index)
        gaussians.means = means[order]
        gaussians.log_scales[child] -= math.log(SPLIT_SHRINK)
        return gaussians

    def _densified(self, grads: Tensor, alive: Tensor) -> Tensor:
        """(N,) bool: whom to clone or split. Each adds one Gaussian, so the cap says how many."""
        dense = alive & (grads > self.knobs.grad_threshold)
        if self.knobs.max_gaussians > 0:
            room = max(0, self.knobs.max_gaussians - int(alive.sum()))
            candidates = torch.nonzero(dense)[:, 0]
            order = torch.argsort(grads[candidates], descending=True, stable=True)
            dense[candidates[order[room:]]] = False
        return dense

    def _offsets(self, gaussians: Gaussians, parents: Tensor) -> Tensor:
        """(M, 3) draws from N(0, Σ) of the Gaussians ``parents`` (M,): R S ε, in world units."""
        scales = gaussians.log_scales[parents].exp()
        offsets = scales * torch.randn(scales.shape, generator=self.generator).to(scales)
        return (rotation_from_quat(gaussians.quats[parents]) @ offsets[:, :, None])[:, :, 0]

    def state_tensors(self) -> dict[str, Tensor]:
        """The statistics, by name."""
        return {"grad_sum": self.grad_sum, "views": self.views, "max_radii": self.max_radii}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over (copy) what `state_tensors` gave."""
        for name, tensor in self.state_tensors().items():
            setattr(self, name, tensors[name].to(tensor.device, copy=True))
