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
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.training.parts.part import Part

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two applications.
INTERVAL = 100
#: At most this number of cameras is used, evenly chosen, to limit the time.
_CAMERAS = 64
#: Distances are computed for this number of Gaussians at a time, to limit the memory.
_ROWS = 1 << 14


class ScaleLimit(Part):
    """Limits the scales. It has no state."""

    name = "scale_limit"

    def __init__(self, ratio: float) -> None:
        """
        ``ratio``: largest scale, in units of the distance to the nearest camera.
        """
        self.ratio = ratio

    def between(self, run: Run) -> None:
        """Reduce the scales that exceed the limit, in place, in every `INTERVAL`-th step."""
        if run.schedule.multiples(run.step, INTERVAL):
            distances = distances_to_cameras(run.gaussians.means, run.dataset_cameras)
            limit = (self.ratio * distances).log()
            scales = run.gaussians.log_scales
            scales.copy_(torch.minimum(scales, limit[:, None]))


def distances_to_cameras(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """(N,): the distance of each mean (N, 3) to the nearest of at most 64 cameras, in world units;
    not 0.
    """
    used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
    centres = torch.stack([camera.position for camera in used]).to(torch.float32)
    # A product of matrices would be inaccurate for short distances.
    exact = "donot_use_mm_for_euclid_dist"
    nearest = [
        torch.cdist(part, centres, compute_mode=exact).amin(1) for part in means.split(_ROWS)
    ]
    # A mean may be in the centre of a camera.
    return torch.cat(nearest).clamp_min(torch.finfo(torch.float32).tiny)
