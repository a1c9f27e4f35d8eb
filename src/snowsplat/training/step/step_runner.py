"""`StepRunner`: runs a training step on a GPU without waiting for the GPU within the step.

The CPU queues work for the GPU, and the GPU executes it later. If the CPU waited for a result in
the middle of a step, the GPU would be idle until the CPU has queued the rest of the step. But a
step depends on three results:

- The rasterizer needs memory for its instances (pairs of a splat and a tile that it touches). Their
  number is computed on the GPU. Memory is allocated for an estimated number, the *capacity*.
- If the loss is not finite, the step must not change anything.
- Values whose update is not finite are skipped and counted (`ops.adam_step`). Training stops at the
  next step, which must not change anything.

These three conditions are combined on the device to one bool: whether the step is *valid*. The
operations that change the state of the training read this bool on the device (`ViewGradient`), and
do nothing if it is False. After the CPU has queued the complete step, it reads the three numbers
back, while the GPU still computes the backward pass. If the capacity was too small, it repeats the
step. If a value was not finite, it raises `Diverged`.

On the CPU, the same code runs, but every operation is complete when it returns, and the memory
always suffices. Only the initial capacity is different.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import NamedTuple

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.gaussian_parameters import PARAMETERS
from snowsplat.ops.readback import Readback
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import RenderOutput
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.step import finite
from snowsplat.training.step.view_gradient import ViewGradient

#: Initial capacity, in instances per Gaussian. A visible Gaussian has about seven instances, and a
#: view shows only a part of the scene. If the capacity is too small, one step is repeated.
INITIAL_INSTANCES_PER_GAUSSIAN = 4
#: The capacity grows when a step uses more than this fraction of it. So it usually grows before a
#: view exceeds it: the required number differs between views, but changes slowly during training.
GROW_ABOVE = 0.9
#: A new capacity is this multiple of the required instances. This is enough for one densification:
#: it increases the number of Gaussians by at most about a quarter.
GROWTH = 1.3


class Summary(NamedTuple):
    """The result of a step: ``table`` has a row (views + 2 + 6,) of float64 for each process: the
    losses, the required and the available instances, and the counts of non-finite rows.
    ``valid`` is (1,) bool."""

    table: Tensor
    valid: Tensor


class StepRunner:
    """Runs training steps: capacity, validity, read-back, repetition and `Diverged`::

        def optimize() -> None:
            splats = project(gaussians, camera, sh_degree)
            with torch.enable_grad():
                image = runner.rasterize(splats, camera, background).image
                loss = view_loss(image, photo, background, ssim_weight)
            runner.backward(loss)
            gradient = runner.gradient(splats, camera, sh_degree)
            density.after_backward(step, gaussians, gradient)
            optimizer.step(gaussians, [gradient], step)

        [loss] = runner.run(optimize, step, gaussians, [view])

    With a batch of views, the forward and the backward pass run once for each view, and there is
    one gradient for each view; see `batch_gradients`.
    """

    def __init__(
        self,
        gaussians: int,
        device: torch.device,
        abs_grad: bool = False,
        batch: int = 1,
        shards: Shards = ALONE,
        *,
        with_depth: bool = False,
    ) -> None:
        """
        Args:
            gaussians: their initial number, from which the initial capacity is estimated.
            abs_grad: whether the backward pass computes ``abs_grad`` of the splats.
            batch: the largest number of views of a step.
            shards: the processes; a step is valid if it is valid in each of them.
            with_depth: whether the depth is rendered, too.
        """
        # The CPU allocates what a frame requires, and ignores the capacity.
        on_cpu = device.type == "cpu"
        instances = sys.maxsize if on_cpu else INITIAL_INSTANCES_PER_GAUSSIAN * gaussians
        self.capacity = Capacity(instances, torch.zeros(1, dtype=torch.int64, device=device))
        self.abs_grad, self.with_depth = abs_grad, with_depth
        self._shards = shards
        self._nonfinite_rows = torch.zeros(len(PARAMETERS), dtype=torch.int32, device=device)
        self._own_views = -(-batch // shards.size)  # at most, of a step
        # Of the views of this process in the present step, until the read-back starts.
        self._losses: list[Tensor] = []
        self._required = self.capacity.required
        self._valid: Tensor | None = None
        numbers = self._own_views + 2 + len(PARAMETERS)
        self._readback = Readback(shards.size * numbers, device)

    def rasterize(self, splats: Splats2D, camera: Camera, background: Tensor) -> RenderOutput:
        """Rasterize with the current capacity; gradients flow to ``splats.packed``.

        ``background``: (3,) colour in 0..1.
        """
        splats.packed.requires_grad_()
        if self.abs_grad:
            splats.abs_grad = splats.packed.new_zeros(len(splats), 2)
        image, alpha, depth = ops.rasterize(
            splats,
            camera.width,
            camera.height,
            background,
            with_depth=self.with_depth,
            capacity=self.capacity,
        )
        return RenderOutput(image, alpha, depth, splats)

    def backward(self, loss: Tensor | None, *, last: bool = True) -> None:
        """Run the backward pass from the loss of a view to its splats.

        Args:
            loss: (); None if this process has no view in this round.
            last: whether this is the last view of the step. Then the read-back starts, before the
                backward pass.
        """
        if loss is not None:
            self._losses.append(loss.detach())
            self._required = torch.maximum(self._required, self.capacity.required)
        if last:
            self.send(self.summary(self._losses, self._required))
            self._losses, self._required = [], torch.zeros_like(self._required)
        if loss is not None:
            loss.backward()

    def summary(self, losses: Sequence[Tensor], required: Tensor) -> Summary:
        """What the CPU reads back in a step, and whether the step is valid.

        Args:
            losses: (), of the views of this process.
            required: (1,) int64, the largest number of instances of a view.
        """
        device = self._nonfinite_rows.device
        unused = torch.zeros(self._own_views - len(losses), device=device)
        numbers = [loss.reshape(1) for loss in losses]
        instances = torch.full((1,), self.capacity.instances, dtype=torch.float64, device=device)
        numbers += [unused, required, instances, self._nonfinite_rows]
        table = self._shards.table(torch.cat([number.double() for number in numbers]))
        found, required, instances, rows = table.split(
            [self._own_views, 1, 1, len(PARAMETERS)], dim=1
        )
        valid = found.isfinite().all() & (required <= instances).all() & ~rows.any()
        return Summary(table, valid.reshape(1))

    def send(self, summary: Summary) -> None:
        """Start the read-back of the summary of the present step."""
        self._readback.start(summary.table)
        self._valid = summary.valid

    def gradient(self, splats: Splats2D, camera: Camera, sh_degree: int) -> ViewGradient:
        """The gradient of a view, after the last backward pass of the step."""
        return ViewGradient(splats, camera, sh_degree, self._valid, self._nonfinite_rows)

    def run(
        self,
        optimize: Callable[[], None],
        step: int,
        gaussians: Gaussians,
        views: Sequence[View],
        photos: Sequence[LoadedImage | None] = (),
    ) -> list[float]:
        """Run one step. If the capacity was too small, repeat the step with a larger capacity.

        Args:
            optimize: queues the step, through `rasterize` and `backward`.
            step, gaussians, views, photos: used for the message of an error.

        Returns: The loss of each view.

        Raises: Diverged: a loss is not finite, or the update of the previous step was not.
        """
        while True:
            optimize()
            # The complete step is queued. A GPU computes it while the CPU waits for the losses.
            values = self._readback.wait()
            numbers = len(values) // self._shards.size
            table = [values[i : i + numbers] for i in range(0, len(values), numbers)]
            required, instances = table[self._shards.rank][self._own_views], self.capacity.instances
            if required > GROW_ABOVE * instances:
                self.capacity = replace(self.capacity, instances=int(GROWTH * required))
            if all(row[self._own_views] <= row[self._own_views + 1] for row in table):
                break
        # The counts were copied before the update of this step, so they are for the previous steps.
        counts = [row[self._own_views + 2 :] for row in table]
        finite.check_updates(
            step - 1, [sum(column) for column in zip(*counts, strict=True)], gaussians
        )
        # In each round, process i has view i.
        losses = [table[i % len(table)][i // len(table)] for i in range(len(views))]
        for loss, view, photo in zip_longest(losses, views, photos):
            finite.check_loss(step, loss, gaussians, view, photo)
        return losses

    def finish(self, step: int, gaussians: Gaussians) -> None:
        """Wait for the device, and check the update of the last step, ``step``.

        Raises: Diverged: the update was not finite.
        """
        finite.check_updates(step, self._nonfinite_rows.tolist(), gaussians)

    def reset(self) -> None:
        """Set the counts of skipped rows to 0, after the state of the training was replaced."""
        self._nonfinite_rows.zero_()
