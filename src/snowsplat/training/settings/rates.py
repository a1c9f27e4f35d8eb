"""`LearningRates` of Adam and their schedules; `DecayRates` of opacities and scales."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

from snowsplat.training.settings.schedule import Schedule
from snowsplat.util.settings import Settings, When, flag, setting

# The factor of the rate of the view-dependent colours with few passes over the photos, as measured:
# see "few passes" in docs/performance.md.
#: The power of the ratio of `sh_rest_passes` to the passes. With 1, a colour can change as much in
#: total as with more passes; with more than 1, it also reaches its value earlier.
_POWER_OF_PASSES = 1.5
#: The largest factor.
_LARGEST_FACTOR = 6.0


@dataclass(frozen=True)
class LearningRates(Settings):
    """Adam's learning rate for each parameter; the defaults are those of the paper.

    The rates of all parameters except the positions are constant until ``anneal_from``.
    """

    prefix: ClassVar[str] = "lr_"

    # The schedule interpolates the logarithms of these two rates.
    means: float = flag(
        1.6e-4,
        "Learning rate of the positions at the first step, in units of the scene extent.",
        above=0.0,
        allowed="a number above 0, e.g. 1e-12",
        aliases=("--position-lr-init",),
    )
    means_final: float = flag(
        1.6e-6,
        "Learning rate of the positions from step `lr_means_steps` on, in the same units.",
        above=0.0,
        allowed="a number above 0, e.g. 1e-12",
        aliases=("--position-lr-final",),
    )
    means_steps: When = flag(
        30_000,
        "Step at which the learning rate of the positions reaches its final value. A value with a "
        "decimal point (1.0) is a fraction of all steps.",
        least=0,
        largest_fraction=math.inf,
        aliases=("--position-lr-max-steps",),
    )
    log_scales: float = flag(
        5e-3, "Learning rate of the scales.", least=0.0, aliases=("--scaling-lr",)
    )
    quats: float = flag(
        1e-3, "Learning rate of the rotations.", least=0.0, aliases=("--rotation-lr",)
    )
    opacity_logits: float = flag(
        0.05, "Learning rate of the opacities.", least=0.0, aliases=("--opacity-lr",)
    )
    sh_dc: float = flag(2.5e-3, "Learning rate of the base colours.", least=0.0)
    sh_rest: float = flag(
        2.5e-3 / 20,
        "Learning rate of the view-dependent colours; if it is set, `lr_sh_rest_passes` is 0 "
        "unless it is set, too.",
        least=0.0,
    )
    sh_rest_passes: float = flag(
        0.0,
        "With fewer passes over the photos than this, the rate of the view-dependent colours is "
        "higher by the power 1.5 of the ratio, at most six times: a colour can change as much in "
        "total, and reaches its value earlier; 0: never.",
        least=0.0,
    )
    anneal: float = setting(
        1.0,
        "Factor of all these rates but that of the positions at the last step. With a factor below "
        "1, the parameters converge, instead of following the view of the last steps.",
        above=0.0,
    )
    anneal_from: float = setting(
        0.6,
        "Fraction of all steps, from which on these rates are interpolated log-linearly.",
        least=0.0,
        below=1.0,
    )

    def scaled(self, factor: float) -> LearningRates:
        """These rates, multiplied by ``factor`` except ``means_final``; for short training runs."""
        rates = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
        return replace(self, **{name: factor * getattr(self, name) for name in rates})

    def at(self, step: int, schedule: Schedule, extent: float, views: int = 0) -> dict[str, float]:
        """The learning rate of each parameter at ``step``; that of the means is in world units.

        means(t) = extent · means^(1 − t) · means_final^t, t = step / means_steps, at most 1.
        The other rates are multiplied by anneal^u, where u increases from 0 at ``anneal_from`` to 1
        at the last step.

        Args:
            views: the number of training views, for ``sh_rest_passes``.
        """
        # Adam changes a coefficient by about its rate in each step that shows it.
        few = self.sh_rest_passes * views / schedule.iterations
        faster = min(max(1.0, few) ** _POWER_OF_PASSES, _LARGEST_FACTOR)
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
            "sh_rest": factor * faster * self.sh_rest,
        }


@dataclass(frozen=True)
class DecayRates(Settings):
    """The rates of `snowsplat.training.parts.decay`; the defaults, 0, disable it."""

    prefix: ClassVar[str] = "decay_"

    opacity: float = setting(
        0.0,
        "Fraction of its opacity that a Gaussian loses per epoch. With fewer than 50 views, it is "
        "larger.",
        least=0.0,
    )
    scale: float = setting(
        0.0, "Fraction of its scales that a Gaussian loses per epoch.", least=0.0
    )
    until: When = setting(
        0.9,
        "Last moment of the decay. Afterwards, the remaining Gaussians regain the opacity that the "
        "photos require.",
        least=0,
    )
