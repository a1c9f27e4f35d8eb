"""The gradients of a batch of views: the part of a step in which processes exchange splats."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import RenderOutput, project
from snowsplat.training.processes.shards import Shards
from snowsplat.training.step.step_runner import StepRunner
from snowsplat.training.step.view_gradient import ViewGradient

Each = TypeVar("Each")


@dataclass(frozen=True, eq=False)
class BatchView:
    """A view of a batch, at the resolution of the step. Each one is different from any other.

    ``index`` is that of the view in the training views of the dataset. ``photo`` is None if another
    process blends this view. In a recording, which stands for many views, the index is -1 and the
    photo None, see `Part.recordable`.
    """

    index: int
    view: View
    camera: Camera
    photo: LoadedImage | None
    background: Tensor  # (3,)
    row: Tensor  # (1,) int64 on the device: the index


#: The views of a step, and the gradient of each.
Batch = Sequence[BatchView]
Gradients = Sequence[ViewGradient]


def rounds(batch: Sequence[Each], size: int) -> list[Sequence[Each]]:
    """The views, or one value for each, in groups of at most ``size``: in each round, process i
    blends view i.
    """
    return [batch[first : first + size] for first in range(0, len(batch), size)]


def batch_gradients(
    gaussians: Gaussians,
    batch: Batch,
    runner: StepRunner,
    shards: Shards,
    sh_degree: int,
    background_of: Callable[[BatchView], Tensor],
    loss_of: Callable[[BatchView, RenderOutput], Tensor],
) -> list[ViewGradient]:
    """The gradients of the mean loss of the batch with respect to the splats of each view.

    Args:
        gaussians: those of this process.
        batch: the views, the same in every process.
        runner: rasterizes, and runs the backward pass.
        background_of: the colour (3,) over which a view is rendered.
        loss_of: the loss of a view whose photo this process has, and of its rendering.
    """
    found: list[tuple[Splats2D, BatchView]] = []
    views = rounds(batch, shards.size)
    for number, group in enumerate(views):
        splats = [project(gaussians, each.camera, sh_degree) for each in group]
        if shards.size > 1:
            splats = [view.without_empty_rows() for view in splats]
        blended = shards.exchange(splats)
        loss = None
        if blended is not None:
            own = group[shards.rank]
            with torch.enable_grad():  # `project` is outside: the optimiser computes its gradient
                rendered = runner.rasterize(blended, own.camera, background_of(own))
                loss = loss_of(own, rendered)
                del rendered
        runner.backward(loss, last=number == len(views) - 1)
        del loss  # and with it the image and the tiles
        if blended is not None:
            _multiply_gradient(blended, 1.0 / len(batch))
        shards.return_gradients(blended, splats, absolute=runner.abs_grad)
        found += zip(splats, group, strict=True)
    return [runner.gradient(splats, each.camera, sh_degree) for splats, each in found]


def _multiply_gradient(splats: Splats2D, factor: float) -> None:
    """In place: a multiple of the gradient of the image would need memory."""
    assert splats.packed.grad is not None
    for gradient in (splats.packed.grad, splats.abs_grad):
        if gradient is not None and factor != 1.0:
            gradient *= factor
