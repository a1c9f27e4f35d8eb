"""`Adam` for Gaussians: moments that follow the rows. Learning rates are in `lr_schedule`.

The arithmetic of a step is `ops.adam_step`, which carries the gradient of the splats through the
projection and updates the parameters in the same pass. This class owns the state between steps.
"""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.scratch import take_rows
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.lr_schedule import LearningRates
from snowsplat.training.step_schedule import Schedule
from snowsplat.training.view_gradient import ViewGradient


class Adam:
    """The first and second moments of every parameter, in the order of the rows.

    It does not own the Gaussians. Code that changes their rows (density control) makes the same
    change here with `select`, so that row i of every moment belongs to Gaussian i.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        rates: LearningRates,
        *,
        schedule: Schedule,
        extent: float,
        visible_only: bool = False,
    ) -> None:
        """
        Args:
            extent: extent of the scene, in world units; scales the learning rate of the means.
            visible_only: a step leaves the Gaussians that its view does not see unchanged.
        """
        self.rates = rates
        self.schedule = schedule
        self.extent = extent
        self.visible_only = visible_only
        parameters = gaussians.parameters()
        self.exp_avg = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(p) for name, p in parameters.items()}

    def rates_at(self, step: int) -> dict[str, float]:
        """Learning rate by parameter at ``step``, counted from 1."""
        return self.rates.at(step, self.schedule, self.extent)

    def step(self, gaussians: Gaussians, gradient: ViewGradient, step: int) -> None:
        """Update ``gaussians`` in place; ``step`` counts from 1.

        A ``.grad`` on a parameter (of a regulariser) is added to its gradient, then cleared.
        """
        parameters = gaussians.parameters()
        splats, camera = gradient.splats, gradient.camera
        assert splats.ids is not None
        assert splats.packed.grad is not None
        ops.adam_step(
            parameters,
            self.exp_avg,
            self.exp_avg_sq,
            splats.ids,
            splats.packed.grad,
            camera.cam_from_world,
            width=camera.width,
            height=camera.height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            sh_degree=gradient.sh_degree,
            lr=self.rates_at(step),
            step=step,
            visible_only=self.visible_only,
            valid=gradient.valid,
            nonfinite_rows=gradient.nonfinite_rows,
        )
        for parameter in parameters.values():
            parameter.grad = None

    def select(self, index: Tensor, fresh: Tensor) -> None:
        """Row i becomes the old row ``index[i]``; rows marked in ``fresh`` get zero moments.

        Args:
            index: (M,) int64, repeats allowed.
            fresh: (M,) bool.
        """
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name, moment in moments.items():
                moments[name] = take_rows(moment, index)
                moments[name][fresh] = 0.0

    def zero(self, name: str) -> None:
        """Set the moments of one parameter to zero, after its values were set directly."""
        self.exp_avg[name].zero_()
        self.exp_avg_sq[name].zero_()

    def state_tensors(self) -> dict[str, Tensor]:
        """Everything that has to be saved, by name. Not copied."""
        averages = {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
        return averages | {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""
        for name, average in self.exp_avg.items():
            for moments, key in ((self.exp_avg, "exp_avg"), (self.exp_avg_sq, "exp_avg_sq")):
                moments[name] = tensors[f"{key}.{name}"].to(average.device, copy=True)
