"""`SmoothingFilter`: no Gaussian is thinner than what the photos can show of it, except for discs.

A photo of focal length f samples a Gaussian at depth d with the rate f / d, in pixels per world
unit. Let ν be the largest rate of all photos that show it. Details that are much finer than 1 / ν
cannot be trained. But in the photos a thinner Gaussian looks the same, because the projection blurs
it to the size of a pixel; nearer to the camera, or in a larger image, it becomes an edge or a
needle. Mip-Splatting (Yu et al., CVPR 2024) therefore convolves each Gaussian with one of the
variance s / ν², its 3D smoothing filter: Σ + s / ν² I. The Gaussians that result are those whose
standard deviations are at least √s / ν. So here this is a lower limit of the scales, without
further parameters, and every viewer shows the filtered scene.

The smallest of the three scales has no limit. A disc of any thickness looks the same from the
front, and surfaces need thin discs; with a limit for all scales, the photos are reproduced less
well. A needle has two small scales, so there are no needles.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from snowsplat import ops
from snowsplat.ops import Frusta
from snowsplat.scene.sight import frusta_of
from snowsplat.training.parts.part import Part

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two applications.
INTERVAL = 100
#: s: the variance of the filter, in units of the distance between samples, squared.
VARIANCE = 0.2


class SmoothingFilter(Part):
    """Limits the scales. It has no state."""

    name = "smoothing"
    _frusta: Frusta

    def begin(self, run: Run) -> None:
        """Compute the frusta of the training views."""
        depths = [(camera.near, math.inf) for camera in run.dataset_cameras]
        self._frusta = frusta_of(run.dataset_cameras, depths).to(run.gaussians.means)

    def between(self, run: Run) -> None:
        """Raise the scales below the limit, except for the smallest one of each Gaussian, in place,
        in every `INTERVAL`-th step.
        """
        if run.schedule.multiples(run.step, INTERVAL):
            # The most pixels per world unit with which an image shows the mean, or 0.
            _, rates = ops.points_in_frusta(run.gaussians.means, self._frusta)
            limit = math.sqrt(VARIANCE) / rates  # inf for a Gaussian that no photo shows
            limit = limit.nan_to_num(posinf=0.0).log()
            scales = run.gaussians.log_scales
            smallest = scales.argmin(1, keepdim=True)
            raised = torch.maximum(scales, limit[:, None])
            scales.copy_(raised.scatter(1, smallest, scales.gather(1, smallest)))
