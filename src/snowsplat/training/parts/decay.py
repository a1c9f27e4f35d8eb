"""`Decay`: a steady pressure on opacities and scales, which removes what no photo needs.

Opacities and scales shrink by a small factor, independent of the optimiser ("decoupled weight
decay", Loshchilov and Hutter, ICLR 2019). Adam normalises the gradient. So it restores a Gaussian
that matters in the photos. A Gaussian whose gradient has no constant direction, such as a floater
in front of a camera, fades until it is pruned, and density control can use its place. Without
this, a scene with few photos has large semi-transparent Gaussians near the cameras: each of them
corrects the errors of one photo. A decay of the opacity: Han et al., "Binocular-Guided 3D Gaussian
Splatting with View Consistency for Sparse View Synthesis", NeurIPS 2024.

The rates are per epoch, that is, per as many steps as there are training views. So with fewer
views, the pressure of a training run of a given length is higher: its photos are repeated more
often, and it needs more regularisation. With fewer than `MANY_VIEWS` views, the rate of the
opacity is also larger, because fewer photos show each place.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from snowsplat.training.parts.part import Part
from snowsplat.training.settings.rates import DecayRates

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two reductions.
INTERVAL = 10
#: With fewer views, the rate of the opacity is multiplied by `MANY_VIEWS` / views, at most by
#: `MAX_FACTOR`.
MANY_VIEWS = 50
MAX_FACTOR = 2.5


class Decay(Part):
    """Applies `DecayRates`. It has no state."""

    name = "decay"

    def __init__(self, rates: DecayRates) -> None:
        self.rates = rates

    def between(self, run: Run) -> None:
        """Reduce opacities and scales in place, in every `INTERVAL`-th step."""
        times = run.schedule.multiples(run.step, INTERVAL)
        if not times or run.step > run.schedule.step_of(self.rates.until):
            return
        views = len(run.dataset.train)  # the steps of an epoch
        epochs = times * (INTERVAL / views)
        opacity = self.rates.opacity * min(max(1.0, MANY_VIEWS / views), MAX_FACTOR)
        if opacity > 0.0:
            factor = math.exp(-opacity * epochs)
            opacities = factor * run.gaussians.opacities
            run.gaussians.opacity_logits.copy_(torch.logit(opacities, eps=1e-7))
        if self.rates.scale > 0.0:
            run.gaussians.log_scales -= self.rates.scale * epochs
