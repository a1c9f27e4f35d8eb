"""Adam for Gaussians: learning rates with their schedules, and moments that follow the rows.

The arithmetic of a step is `ops.adam_step`, which carries the gradient of the splats through the
projection and updates the parameters in the same pass. Here is what has to outlive a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.scratch import take_rows
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.step_schedule import Schedule, When


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate for each parameter; the defaults are the paper's.

    Attributes:
        means: at the first step, in units of the scene's extent.
        means_final: at step ``means_steps`` and after it; log-linear between the two.
        means_steps: int: that step; float: that fraction of all iterations.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    means_steps: When = 30_000
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20

    def scaled(self, factor: float) -> LearningRates:
        """All rates times ``factor``, but for the final one of the means: for short trainings."""
        rates = [f.name for f in fields(self) if f.name not in ("means_final", "means_steps")]
        return replace(self, **{name: factor * getattr(self, name) for name in rates})

    def at(self, step: int, schedule: Schedule, extent: float) -> dict[str, float]:
        """The rates of one step, by parameter; the one of the means in world units."""
        t = schedule.share(step, self.means_steps)
        means = math.exp((1.0 - t) * math.log(self.means) + t * math.log(self.means_final))
        return {
            "means": means * extent,
            "log_scales": self.log_scales,
            "quats": self.quats,
            "opacity_logits": self.opacity_logits,
            "sh_dc": self.sh_dc,
            "sh_rest": self.sh_rest,
        }


class Adam:
    """The moments of every parameter, in the rows' order, and the rates of the coming step.

    ``nonfinite_rows`` (6,) int32 counts the rows that steps skipped because they were not finite,
    per parameter (`ops.adam_step`); it is reset by `load_state`.

    It does not own the Gaussians. Whoever changes their rows (density control) makes the same
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
        """``visible_only``: a step leaves the Gaussians that its view does not see as they are."""
        self.rates = rates
        self.schedule = schedule
        self.extent = extent
        self.visible_only = visible_only
        parameters = gaussians.parameters()
        self.exp_avg = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.nonfinite_rows = torch.zeros(
            len(parameters), dtype=torch.int32, device=gaussians.means.device
        )

    def rates_at(self, step: int) -> dict[str, float]:
        """Learning rate by parameter at ``step``, counted from 1."""
        return self.rates.at(step, self.schedule, self.extent)

    def step(
        self,
        gaussians: Gaussians,
        splats: Splats2D,
        camera: Camera,
        sh_degree: int,
        step: int,
        valid: Tensor | None = None,
    ) -> None:
        """Update ``gaussians`` in place from ``splats.packed.grad``; ``step`` counts from 1.

        A ``.grad`` on a parameter (of a regulariser) is added to its gradient, and cleared
        afterwards. ``valid``: as of `ops.adam_step`.
        """
        parameters = gaussians.parameters()
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
            sh_degree=sh_degree,
            lr=self.rates_at(step),
            step=step,
            visible_only=self.visible_only,
            valid=valid,
            nonfinite_rows=self.nonfinite_rows,
        )
        for parameter in parameters.values():
            parameter.grad = None

    def select(self, index: Tensor, fresh: Tensor) -> None:
        """Row i becomes the old row ``index[i]``; rows marked in ``fresh`` start with zero moments.

        Args:
            index: (M,) int64, repeats allowed.
            fresh: (M,) bool.
        """
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name, moment in moments.items():
                moments[name] = take_rows(moment, index)
                moments[name][fresh] = 0.0

    def zero(self, name: str) -> None:
        """Forget the moments of one parameter, where its values were set by hand."""
        self.exp_avg[name].zero_()
        self.exp_avg_sq[name].zero_()

    def state_tensors(self) -> dict[str, Tensor]:
        """Everything that has to be saved, by name."""
        averages = {f"exp_avg.{name}": tensor for name, tensor in self.exp_avg.items()}
        return averages | {f"exp_avg_sq.{name}": tensor for name, tensor in self.exp_avg_sq.items()}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over (copy) what `state_tensors` gave."""
        self.nonfinite_rows.zero_()
        for name, average in self.exp_avg.items():
            for moments, key in ((self.exp_avg, "exp_avg"), (self.exp_avg_sq, "exp_avg_sq")):
                moments[name] = tensors[f"{key}.{name}"].to(average.device, copy=True)
