"""`SkyLimit`: no Gaussian is before the sky."""

from __future__ import annotations

import torch

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.parts.near_limit import REMOVED
from snowsplat.training.parts.sky import Sky

#: Number of steps between two applications.
INTERVAL = 200
#: This number of Gaussians is processed at a time, to limit the memory.
_ROWS = 1 << 14


class SkyLimit:
    """Removes Gaussians between the steps of a training run. It has no state."""

    def __init__(self, sky: Sky | None, device: torch.device, schedule: Schedule) -> None:
        """
        Args:
            sky: None: no limit.
            device: that of the Gaussians.
        """
        self._sky = None if sky is None else sky.to(device)
        self._schedule = schedule

    def after_step(self, step: int, gaussians: Gaussians) -> None:
        """Make Gaussians before the sky transparent, in place, in every `INTERVAL`-th step."""
        if self._sky is not None and self._schedule.multiples(step, INTERVAL):
            before = [self._sky.is_before(means) for means in gaussians.means.split(_ROWS)]
            gaussians.opacity_logits.masked_fill_(torch.cat(before), REMOVED)
