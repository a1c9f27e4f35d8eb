"""Density control: adds and removes Gaussians during training.

A density control has two dataclasses: its settings, and its state. The settings are frozen and part
of `TrainConfig`; those of the package are in `snowsplat.training.settings.density`.
`density_control` creates the state, which follows the protocol `DensityControl`. The trainer uses
only these two dataclasses. `AdaptiveDensity` is the density control of the paper, and `McmcDensity`
is that of Kheradmand et al. 2024.
"""

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.density.adaptive import AdaptiveDensityControl
from snowsplat.training.density.mcmc import McmcDensityControl
from snowsplat.training.settings.density import (
    DENSITY_CONTROLS,
    AdaptiveDensity,
    DensityConfig,
    DensitySettings,
    McmcDensity,
    register_density,
)
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.overrides import check_overrides

__all__ = [
    "DENSITY_CONTROLS",
    "AdaptiveDensity",
    "DensityConfig",
    "DensityControl",
    "DensitySettings",
    "McmcDensity",
    "density_control",
    "register_density",
]


class DensityControl(Protocol):
    """The state of a density control: statistics with one row per Gaussian, and two hooks.

    A class that inherits from this one overrides what it needs; the others do nothing.
    """

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
        return gaussians

    def state_tensors(self) -> dict[str, Tensor]:
        """The statistics by name, for a checkpoint. The tensors are not copied."""
        return {}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""


#: The state of each density control of the package: from its settings and the arguments of
#: `density_control`.
_STATES: dict[type, Callable[..., DensityControl]] = {
    AdaptiveDensity: AdaptiveDensityControl.begin,
    McmcDensity: McmcDensityControl.begin,
}


def density_control(settings: Any, count: int, **state: Any) -> DensityControl:
    """The initial state of a density control.

    Args:
        settings: a `DensityConfig`. If it is from outside of the package, it has a method
            ``control`` with the other arguments of this function, which returns the state.
        count: number of Gaussians of this process.
        state: schedule (`Schedule`); extent, of the scene in world units; random_init, whether
            training starts from random points instead of SfM points; generator, a random generator
            on the CPU; device, of the Gaussians, default: the CPU; shards, the processes of the
            training, default: this one alone.
    """
    if hasattr(settings, "control"):
        made: DensityControl = settings.control(count, **state)
        check_overrides(type(made), DensityControl)
        return made
    begin = next(begin for kind, begin in _STATES.items() if isinstance(settings, kind))
    return begin(settings, count, **state)
