"""`SmoothingFilter`: no Gaussian is smaller than what the photos can show of it.

A photo of focal length f samples a Gaussian at depth d with the rate f / d, in pixels per world
unit. Let ν be the largest rate of all photos that show it. Details that are much finer than 1 / ν
cannot be trained. But in the photos a thinner Gaussian looks the same, because the projection blurs
it to the size of a pixel; nearer to the camera, or in a larger image, it becomes an edge or a
needle. Mip-Splatting (Yu et al., CVPR 2024) therefore convolves each Gaussian with one of the
variance s / ν², its 3D smoothing filter: Σ + s / ν² I. The Gaussians that result are those whose
standard deviations are at least √s / ν. So here this is a lower limit of the scales. A training run
finds the same Gaussians, without further parameters, and every viewer shows the filtered scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.step_schedule import Schedule

#: Number of steps between two applications.
INTERVAL = 100
#: s: the variance of the filter, in units of the distance between samples, squared.
VARIANCE = 0.2
#: Photos show only what is farther away, in world units: the default of `ops.project`.
_NEAR = 0.2


class SmoothingFilter:
    """Limits the scales between the steps of a training run. It has no state."""

    def __init__(self, enabled: bool, cameras: Sequence[Camera], schedule: Schedule) -> None:
        """
        Args:
            cameras: those of the training views, on the device of the Gaussians.
        """
        self._cameras = cameras if enabled else ()
        self._schedule = schedule

    def after_step(self, step: int, gaussians: Gaussians) -> None:
        """Raise the scales below the limit, in place, in every `INTERVAL`-th step."""
        if self._cameras and self._schedule.multiples(step, INTERVAL):
            rates = sampling_rates(gaussians.means, self._cameras)
            limit = math.sqrt(VARIANCE) / rates  # inf for a Gaussian that no photo shows
            limit = limit.nan_to_num(posinf=0.0).log()
            gaussians.log_scales.copy_(torch.maximum(gaussians.log_scales, limit[:, None]))


def sampling_rates(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """(N,): the most pixels per world unit with which an image shows each mean (N, 3), or 0."""
    rates = means.new_zeros(len(means))
    for camera in cameras:
        pixel, depth = camera.project(means)
        size = pixel.new_tensor([camera.width, camera.height])
        inside = (depth > _NEAR) & (pixel >= 0.0).all(1) & (pixel <= size).all(1)
        rate = max(camera.fx, camera.fy) / depth
        rates = torch.maximum(rates, rate.where(inside, 0.0).to(rates.dtype))
    return rates
