"""Density control: where Gaussians are added and taken away during training.

A variant is a file with two dataclasses: its knobs (frozen; part of `TrainConfig`), whose
``control`` method makes its state, which follows the `DensityControl` protocol below. The trainer
knows only these two. `AdaptiveDensity` is the paper's method, `McmcDensity` that of Kheradmand et
al. 2024.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from snowsplat.ops.splats import Splats2D
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.density.adaptive import AdaptiveDensity
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.optim import Adam
from snowsplat.training.step_schedule import Schedule, When

__all__ = ["AdaptiveDensity", "DensityConfig", "DensityControl", "McmcDensity"]


class DensityControl(Protocol):
    """The state of a density control: statistics in the rows' order, and two hooks."""

    def after_backward(
        self,
        step: int,
        gaussians: Gaussians,
        splats: Splats2D,
        width: int,
        height: int,
        valid: Tensor | None = None,
    ) -> None:
        """Before the optimiser: gather statistics of ``splats.packed.grad``, or add regularisers.

        ``width`` and ``height`` (pixels) are those of this step's image, coarse or fine. The
        gradient of a regulariser goes to ``.grad`` of the parameters. ``valid``: as of
        `ops.adam_step`, (1,) bool on the device; where it is False the step will not count.
        """

    def after_step(self, step: int, gaussians: Gaussians, optimizer: Adam) -> Gaussians:
        """After the optimiser: refine. Gives the Gaussians to go on with, maybe the same ones.

        The trainer calls this as late as it can, at the beginning of step + 1, so that what is
        evaluated and saved between two steps is never a scene that was just cloned or reset.

        Raises:
            Diverged: where it refines, parameters that are not finite.
        """
        ...

    def state_tensors(self) -> dict[str, Tensor]:
        """Statistics, by name, for a checkpoint."""
        ...

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `state_tensors` gave."""


class DensityConfig(Protocol):
    """The knobs of a density control: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def max_gaussians(self) -> int:
        """Hard cap of their number; 0 is none. The initial ones keep to it too."""
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
        random_start: bool,
        generator: torch.Generator,
        device: torch.device | None = None,
    ) -> DensityControl:
        """Fresh state for ``count`` Gaussians in a scene of ``extent`` world units.

        ``random_start``: they are random points, not those of a dataset. ``generator``: of the CPU.
        ``device``: where the Gaussians are; default: the CPU.
        """
        ...
