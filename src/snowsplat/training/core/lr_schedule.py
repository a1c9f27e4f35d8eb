"""`LearningRates`: the learning rates of Adam and their schedules."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from snowsplat.training.core.step_schedule import Schedule, When


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate for each parameter; the defaults are those of the paper.

    Attributes:
        means: rate of the positions at the first step, in units of the scene extent.
        means_final: rate of the positions from step ``means_steps`` on; before that step, the rate
            is interpolated log-linearly.
        means_steps: a step (int), or a fraction of all iterations (float).
        log_scales, quats, opacity_logits, sh_dc, sh_rest: rates until ``anneal_from``.
        anneal: factor of these rates at the last step. With a factor below 1, the parameters
            converge, instead of following the view of the last steps.
        anneal_from: fraction of all steps, from which on these rates are interpolated
            log-linearly.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    means_steps: When = 30_000
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20
    anneal: float = 1.0
    anneal_from: float = 0.6

    def scaled(self, factor: float) -> LearningRates:
        """These rates, multiplied by ``factor`` except ``means_final``; for short training runs."""
        rates = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
        return replace(self, **{name: factor * getattr(self, name) for name in rates})

    def at(self, step: int, schedule: Schedule, extent: float) -> dict[str, float]:
        """The learning rate of each parameter at ``step``; that of the means is in world units.

        means(t) = extent · means^(1 − t) · means_final^t, t = step / means_steps, at most 1.
        The other rates are multiplied by anneal^u, where u increases from 0 at ``anneal_from`` to 1
        at the last step.
        """
        t = schedule.share(step, self.means_steps)
        means = math.exp((1.0 - t) * math.log(self.means) + t * math.log(self.means_final))
        u = (schedule.share(step) - self.anneal_from) / (1.0 - self.anneal_from)
        factor = self.anneal ** max(0.0, u)
        return {
            "means": means * extent,
            "log_scales": factor * self.log_scales,
            "quats": factor * self.quats,
            "opacity_logits": factor * self.opacity_logits,
            "sh_dc": factor * self.sh_dc,
            "sh_rest": factor * self.sh_rest,
        }
