"""`Densification`: the density control of a configuration as a part."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from snowsplat.training.density import DensityConfig, DensityControl, density_control
from snowsplat.training.parts.part import Part
from snowsplat.training.starts.init import starts_at_random
from snowsplat.training.step.batch import Batch, Gradients

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run


#: If Gaussians are added late, the first moment: that of the second masks of what moves.
_GROWTH = 0.2


def delay_growth(density: DensityConfig) -> DensityConfig:
    """The density control that adds no Gaussians before that moment."""
    begin = density.densify_from
    # A number of steps is that of a long schedule, whose first masks are later.
    early = not isinstance(begin, float) or begin < _GROWTH
    return replace(density, densify_from=_GROWTH) if early else density


class Densification(Part):
    """Calls a density control.

    Attributes:
        control: its state.
    """

    name = "density"
    control: DensityControl

    def __init__(self, late: bool = False) -> None:
        """
        ``late``: whether no Gaussians are added before the masks of what moves are known.
        """
        self.late = late

    def prepare(self, run: Run) -> None:
        """Read the settings, which are those of the configuration."""
        self.settings = delay_growth(run.config.density) if self.late else run.config.density
        self.abs_grad = self.settings.abs_grad

    def begin(self, run: Run) -> None:
        """Create the state of the density control.

        Raises: SettingError: a setting of the density control is invalid.
        """
        self.control = density_control(
            self.settings,
            len(run.gaussians),
            schedule=run.schedule,
            extent=run.dataset.extent,
            random_init=starts_at_random(run.dataset, run.config),
            generator=run.generators["density"],
            device=run.device,
            shards=run.shards,
        )

    def between(self, run: Run) -> None:
        """See `DensityControl.after_step`."""
        run.gaussians = self.control.after_step(run.step, run.gaussians, run.optimizer)

    def gradients(self, run: Run, step: int, batch: Batch, gradients: Gradients) -> None:
        """See `DensityControl.after_backward`."""
        for gradient in gradients:
            self.control.after_backward(step, run.gaussians, gradient)

    def row_state(self) -> dict[str, Tensor]:
        """See `DensityControl.state_tensors`."""
        return self.control.state_tensors()

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `DensityControl.load_state`."""
        self.control.load_state(tensors)
