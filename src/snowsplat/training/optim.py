"""`Adam` for Gaussians: its moments have the same rows as the Gaussians.

`ops.adam_step` computes a step: it propagates the gradient of the splats through the projection and
updates the parameters in the same pass. `Adam` stores the state between steps. Learning rates are
in `lr_schedule`.
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
    """The first and second moments of every parameter. Row i of a moment belongs to Gaussian i.

    The Gaussians themselves are not part of this object. Code that changes their rows (density
    control) must make the same change here, with `select`.
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
            extent: extent of the scene, in world units; the learning rate of the means is
                multiplied by it.
            visible_only: whether a step leaves Gaussians unchanged that its view does not see.
        """
        self.rates = rates
        self.schedule = schedule
        self.extent = extent
        self.visible_only = visible_only
        parameters = gaussians.parameters()
        self.exp_avg = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(p) for name, p in parameters.items()}

    def rates_at(self, step: int) -> dict[str, float]:
        """The learning rate of each parameter at ``step``, which counts from 1."""
        return self.rates.at(step, self.schedule, self.extent)

    def step(self, gaussians: Gaussians, gradient: ViewGradient, step: int) -> None:
        """Update ``gaussians`` in place; ``step`` counts from 1.

        If a parameter has a ``.grad`` (from a regulariser), it is added to the gradient and
        cleared.
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
        """The state to save, by name. The tensors are not copied."""
        averages = {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
        return averages | {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state_tensors` returned."""
        for name, average in self.exp_avg.items():
            for moments, key in ((self.exp_avg, "exp_avg"), (self.exp_avg_sq, "exp_avg_sq")):
                moments[name] = tensors[f"{key}.{name}"].to(average.device, copy=True)
