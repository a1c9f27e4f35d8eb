"""`Adam` for Gaussians: its moments have the same rows as the Gaussians.

`ops.adam_step` computes a step: it propagates the gradient of the splats through the projection and
updates the parameters in the same pass. `Adam` stores the state between steps.
"""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, InitVar, dataclass, field

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import AdamRates, Moments, SplatGradient, scratch
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.view_gradient import ViewGradient

#: β₂ for a batch of one view.
_BETA2 = 0.999


@dataclass(eq=False)
class Adam:
    """The first and second moments of every parameter. Row i of a moment belongs to Gaussian i.

    The Gaussians themselves are not part of this object. Code that changes their rows (density
    control) must make the same change here, with `select`.

    Attributes:
        extent: extent of the scene, in world units; the learning rate of the means is multiplied
            by it.
        views: number of training views; see `LearningRates.at`.
        beta1: β₁ for a batch of one view.
        visible_only: whether a step leaves Gaussians unchanged that its view does not see.
        shards: the processes; ``gaussians`` are those of this process.
        rows: further tensors with one row for each Gaussian of this process, which `select` keeps
            in the same order; see `Run.rows`.
    """

    gaussians: InitVar[Gaussians]
    rates: LearningRates
    _: KW_ONLY
    schedule: Schedule
    extent: float
    views: int = 0
    beta1: float = 0.9
    visible_only: bool = False
    shards: Shards = ALONE
    rows: dict[str, Tensor] = field(default_factory=dict)

    def __post_init__(self, gaussians: Gaussians) -> None:
        parameters = gaussians.parameters()
        self.exp_avg = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self.exp_avg_sq = {name: torch.zeros_like(p) for name, p in parameters.items()}

    def rates_at(self, step: int) -> dict[str, float]:
        """The learning rate of each parameter at ``step``, which counts from 1."""
        return self.rates.at(step, self.schedule, self.extent, self.views)

    def step(self, gaussians: Gaussians, gradients: Sequence[ViewGradient], step: int) -> None:
        """Update ``gaussians`` in place by the sum of the gradients; ``step`` counts from 1.

        If a parameter has a ``.grad`` (from a regulariser), it is added to the gradient and
        cleared.

        Args:
            gradients: those of the views of the batch, at least one.
        """
        last = gradients[-1]
        if len(gradients) > 1:
            gradient = SplatGradient(_add_up(gaussians, gradients), None)
        else:
            gradient = last.of_splats
        batch = self.schedule.batch
        rates = AdamRates(
            {name: math.sqrt(batch) * rate for name, rate in self.rates_at(step).items()},
            self.schedule.update_of(step),
            (self.beta1**batch, _BETA2**batch),
        )
        ops.adam_step(
            gaussians,
            Moments(self.exp_avg, self.exp_avg_sq),
            gradient,
            last.view(gaussians),
            rates,
            visible_only=self.visible_only,
            valid=last.valid,
            nonfinite_rows=last.nonfinite_rows,
        )
        for parameter in gaussians.parameters().values():
            parameter.grad = None

    def select(self, index: Tensor, fresh: Tensor) -> None:
        """Row i becomes the old row ``index[i]``; rows marked in ``fresh`` become zero.

        Args:
            index: (M,) int64, repeats allowed; rows of all processes.
            fresh: bool, for the new rows of this process.
        """
        take = self.shards.selection(index)
        for tensors in (self.exp_avg, self.exp_avg_sq, self.rows):
            for name, tensor in tensors.items():
                tensors[name] = take(tensor)
                tensors[name][fresh] = 0

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


def _add_up(gaussians: Gaussians, gradients: Sequence[ViewGradient]) -> Tensor:
    """Add the gradients of several views to ``.grad`` of the parameters.

    Returns:
        The ids of the Gaussians that at least one of the views shows, ascending. On a GPU there is
        a row for each Gaussian, with -1 for the others: the CPU need not wait for their number.
    """
    sums = {}
    for name, parameter in gaussians.parameters().items():
        if parameter.grad is None:
            parameter.grad = scratch.empty_like(parameter).zero_()
        sums[name] = parameter.grad
    means = gaussians.means
    # The index -1, an empty row, is the last element: it is no Gaussian.
    seen = torch.zeros(len(means) + 1, dtype=torch.bool, device=means.device)
    for gradient in gradients:
        gradient.add_to(gaussians, sums)
        ids = gradient.splats.ids
        assert ids is not None
        seen[ids.long()] = True
    rows = torch.arange(len(means), dtype=torch.int32, device=means.device)
    return rows[seen[:-1]] if means.device.type == "cpu" else rows.where(seen[:-1], -1)
