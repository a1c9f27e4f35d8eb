"""Density control: adds and removes Gaussians during training.

Each density control is a module with two dataclasses: its settings, and its state. The settings
are frozen and part of `TrainConfig`. `DensityConfig.control` creates the state, which follows the
protocol `DensityControl`. The trainer uses only these two dataclasses. `AdaptiveDensity` is the
density control of the paper, and `McmcDensity` is that of Kheradmand et al. 2024.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.optim import Adam
from snowsplat.training.core.step_schedule import Schedule, When
from snowsplat.training.core.view_gradient import ViewGradient
from snowsplat.training.density.adaptive import AdaptiveDensity
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.processes.shards import ALONE, Shards

__all__ = ["DENSITY_CONTROLS", "AdaptiveDensity", "DensityConfig", "DensityControl", "McmcDensity"]


class DensityControl(Protocol):
    """The state of a density control: statistics with one row per Gaussian, and two hooks."""

    def after_backward(self, step: int, gaussians: Gaussians, gradient: ViewGradient) -> None:
        """Called before the optimiser: accumulates statistics, or adds gradients of regularisers.

        Statistics are accumulated by `ViewGradient.add_statistics`, which changes nothing if the
        step is invalid. The gradient of a regulariser is assigned to ``.grad`` of the parameters.
        The optimiser adds it to the gradient of the loss, and then clears it. This function must
        not wait for a GPU.
        """

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """Called after the optimiser: changes the set of Gaussians. Returns the new Gaussians.

        The trainer calls this at the beginning of step + 1, so that a scene is never evaluated or
        saved directly after densification or an opacity reset. The returned object may be the
        argument.

        Raises:
            Diverged: the parameters are not finite in a step that densifies.
        """
        ...

    def state_tensors(self) -> dict[str, Tensor]:
        """The statistics by name, for a checkpoint. The tensors are not copied."""
        ...

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""


class DensityConfig(Protocol):
    """The settings of a density control: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def max_gaussians(self) -> int:
        """Maximum number of Gaussians, including the initial ones; 0: no limit."""
        ...

    @property
    def abs_grad(self) -> bool:
        """Whether `DensityControl.after_backward` uses ``gradient.splats.abs_grad``."""
        ...

    @property
    def densify_from(self) -> When:
        """The first step at which Gaussians may be added (float: fraction of all steps)."""
        ...

    @property
    def densify_until(self) -> When:
        """The last step at which Gaussians may be added (float: fraction of all steps)."""
        ...

    @property
    def densify_interval(self) -> int:
        """Number of steps between two densifications."""
        ...

    def control(
        self,
        count: int,
        *,
        schedule: Schedule,
        extent: float,
        random_init: bool,
        generator: torch.Generator,
        device: torch.device | None = None,
        shards: Shards = ALONE,
    ) -> DensityControl:
        """The initial state.

        Args:
            count: number of Gaussians of this process.
            extent: extent of the scene, in world units.
            random_init: whether training starts from random points instead of SfM points.
            generator: a random generator on the CPU.
            device: the device of the Gaussians; default: the CPU.
            shards: the processes of the training.
        """
        ...


#: The settings class of every density control, by its name. Checkpoints contain this name.
DENSITY_CONTROLS: dict[str, type[DensityConfig]] = {
    settings.__name__: settings for settings in (AdaptiveDensity, McmcDensity)
}
