"""`LearningRates`: the learning rates of Adam, and the schedule of the rate of the positions."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from snowsplat.training.step_schedule import Schedule, When


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate for each parameter; the defaults are those of the paper.

    Attributes:
        means: rate of the positions at the first step, in units of the scene extent.
        means_final: rate of the positions from step ``means_steps`` on; before that step, the rate
            is interpolated log-linearly.
        means_steps: a step (int), or a fraction of all iterations (float).
        log_scales, quats, opacity_logits, sh_dc, sh_rest: constant rates.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    means_steps: When = 30_000
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20

    def scaled(self, factor: float) -> LearningRates:
        """These rates, multiplied by ``factor`` except ``means_final``; for short training runs."""
        rates = [f.name for f in fields(self) if f.name not in ("means_final", "means_steps")]
        return replace(self, **{name: factor * getattr(self, name) for name in rates})

    def at(self, step: int, schedule: Schedule, extent: float) -> dict[str, float]:
        """The learning rate of each parameter at ``step``; that of the means is in world units.

        means(t) = extent · means^(1 − t) · means_final^t, t = step / means_steps, at most 1.
        """
        t = schedule.share(step, self.means_steps)
        means = math.exp((1.0 - t) * math.log(self.means) + t * math.log(self.means_final))
        return {
            "means": means * extent,
            "log_scales": self.log_scales,
            "quats": self.quats,
            "opacity_logits": self.opacity_logits,
            "sh_dc": self.sh_dc,
            "sh_rest": self.sh_rest,
        }
