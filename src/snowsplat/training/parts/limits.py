"""`Limits`: where no Gaussian may be, and how large or small each may be."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.config import TrainConfig
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.parts.near_limit import NearLimit
from snowsplat.training.parts.scale_limit import ScaleLimit
from snowsplat.training.parts.sky import Sky
from snowsplat.training.parts.sky_limit import SkyLimit
from snowsplat.training.parts.smoothing import SmoothingFilter


class Limits:
    """Applies all limits between the steps of a training run. It has no state."""

    def __init__(
        self,
        config: TrainConfig,
        cameras: Sequence[Camera],
        points: Tensor | None,
        sky: Sky | None,
        schedule: Schedule,
    ) -> None:
        """
        Args:
            cameras: those of the training views, on the device of the Gaussians.
            points: (P, 3) of the dataset, in the world frame.
        """
        device = cameras[0].cam_from_world.device
        self._places = (
            NearLimit(config.near_limit, cameras, points, schedule),
            SkyLimit(sky, device, schedule),
        )
        self._scales = (
            ScaleLimit(config.relative_scale, cameras, schedule),
            SmoothingFilter(config.antialias, cameras, schedule),
        )

    def remove(self, step: int, gaussians: Gaussians) -> None:
        """Make Gaussians transparent that are too near to a camera, or before the sky."""
        for limit in self._places:
            limit.after_step(step, gaussians)

    def limit_scales(self, step: int, gaussians: Gaussians) -> None:
        """Reduce scales that are too large, and raise those that are too small."""
        for limit in self._scales:
            limit.after_step(step, gaussians)
