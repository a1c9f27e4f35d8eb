"""`ScaleLimit`: no Gaussian is large compared to its distance from the cameras.

A few Gaussians grow until they are larger than their distance from the cameras. Each photo shows
only their tails, so the optimiser can use them like a tint for single photos. They cover other
views like a veil: in one training run with the dataset fox, ten of 200,000 Gaussians reduced the
PSNR of a held-out photo from 33.0 to 26.3 dB. The approximation of the projection (eq. 5 of the
paper) is also inaccurate for them.

Mip-Splatting (Yu et al., CVPR 2024) derives a lower limit of the scales from the distance to the
nearest camera; this is an upper limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.step_schedule import Schedule

#: Number of steps between two applications.
INTERVAL = 100
#: At most this number of cameras is used, evenly chosen, to limit the time.
_CAMERAS = 64
#: Distances are computed for this number of Gaussians at a time, to limit the memory.
_ROWS = 1 << 14


class ScaleLimit:
    """Limits the scales between the steps of a training run. It has no state."""

    def __init__(self, ratio: float, cameras: Sequence[Camera], schedule: Schedule) -> None:
        """
        Args:
            ratio: largest scale, in units of the distance to the nearest camera; 0: no limit.
            cameras: those of the training views, on the device of the Gaussians.
        """
        self.ratio = ratio
        self._schedule = schedule
        used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
        self._centres = torch.stack([camera.position for camera in used]).to(torch.float32)

    def after_step(self, step: int, gaussians: Gaussians) -> None:
        """Reduce the scales that exceed the limit, in place, in every `INTERVAL`-th step."""
        if self.ratio > 0.0 and self._schedule.multiples(step, INTERVAL):
            limit = (self.ratio * self._distances(gaussians.means)).log()
            gaussians.log_scales.copy_(torch.minimum(gaussians.log_scales, limit[:, None]))

    def _distances(self, means: Tensor) -> Tensor:
        """(N,): the distance of each mean (N, 3) to the nearest camera, in world units."""
        # A product of matrices would be inaccurate for short distances.
        exact = "donot_use_mm_for_euclid_dist"
        nearest = [
            torch.cdist(part, self._centres, compute_mode=exact).amin(1)
            for part in means.split(_ROWS)
        ]
        # A mean may be in the centre of a camera.
        return torch.cat(nearest).clamp_min(torch.finfo(torch.float32).tiny)
