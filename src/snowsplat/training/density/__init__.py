"""Density control: adds and removes Gaussians during training.

A method is a module with two dataclasses: its settings (frozen; part of `TrainConfig`), whose
``control`` method creates its state, which follows the `DensityControl` protocol. The trainer knows
only these two. `AdaptiveDensity` is the paper's method, `McmcDensity` that of Kheradmand et al.
2024.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.density.adaptive import AdaptiveDensity
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule, When
from snowsplat.training.view_gradient import ViewGradient

__all__ = ["DENSITY_CONTROLS", "AdaptiveDensity", "DensityConfig", "DensityControl", "McmcDensity"]


class DensityControl(Protocol):
    """The state of a density control: statistics in the order of the rows, and two hooks."""

    def after_backward(self, step: int, gaussians: Gaussians, gradient: ViewGradient) -> None:
        """Before the optimiser: accumulate statistics, or add the gradients of regularisers.

        Statistics are accumulated by `ViewGradient.add_statistics`, which changes nothing if the
        step turns out to be invalid. The gradient of a regulariser is assigned to ``.grad`` of the
        parameters, which the optimiser adds and clears. On a GPU nothing here may wait for it.
        """

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """After the optimiser: refine. Returns the Gaussians to continue with, possibly the same.

        The trainer calls this as late as possible, at the beginning of step + 1, so that a scene
        that was just cloned or reset is never evaluated or saved.

        Raises:
            Diverged: the parameters are not finite at a step that refines.
        """
        ...

    def state_tensors(self) -> dict[str, Tensor]:
        """Statistics, by name, for a checkpoint. Not copied."""
        ...

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""


class DensityConfig(Protocol):
    """The settings of a density control: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def max_gaussians(self) -> int:
        """Limit of the number of Gaussians, including the initial ones; 0 is no limit."""
        ...

    @property
    def densify_from(self) -> When:
        """The first moment that may add Gaussians."""
        ...

    @property
    def densify_until(self) -> When:
        """The last moment that may add Gaussians."""
        ...

    @property
    def densify_interval(self) -> int:
        """Steps between two such moments."""
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
    ) -> DensityControl:
        """The initial state.

        Args:
            count: number of Gaussians.
            extent: extent of the scene, in world units.
            random_init: whether training starts from random points, not those of a dataset.
            generator: a random generator on the CPU.
            device: the device of the Gaussians; default: the CPU.
        """
        ...


#: The settings of every method by the name of their class, which a stored configuration names.
DENSITY_CONTROLS: dict[str, type[DensityConfig]] = {
    settings.__name__: settings for settings in (AdaptiveDensity, McmcDensity)
}
