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
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.scene.sight import spheres_of
from snowsplat.training.parts.part import Part

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two applications.
INTERVAL = 100
#: At most this number of cameras is used, evenly chosen, to limit the time.
_CAMERAS = 64


class ScaleLimit(Part):
    """Limits the scales. It has no state."""

    _spheres: Tensor  # the cameras, see `spheres_of`

    name = "scale_limit"

    def __init__(self, ratio: float) -> None:
        """
        ``ratio``: largest scale, in units of the distance to the nearest camera.
        """
        self.ratio = ratio

    def begin(self, run: Run) -> None:
        """Choose the cameras."""
        cameras = run.dataset_cameras[:: math.ceil(len(run.dataset_cameras) / _CAMERAS)]
        self._spheres = spheres_of(cameras, [0.0] * len(cameras)).to(run.device)

    def between(self, run: Run) -> None:
        """Reduce the scales that exceed the limit, in place, in every `INTERVAL`-th step."""
        if run.schedule.multiples(run.step, INTERVAL):
            _, distances = ops.points_in_spheres(run.gaussians.means, self._spheres)
            # A mean may be in the centre of a camera.
            limit = (self.ratio * distances.clamp_min(torch.finfo(torch.float32).tiny)).log()
            scales = run.gaussians.log_scales
            scales.copy_(torch.minimum(scales, limit[:, None]))
