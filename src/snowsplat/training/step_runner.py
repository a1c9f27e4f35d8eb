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

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.dataset import View
from snowsplat.data.decode import LoadedImage
from snowsplat.ops.adam import PARAMETERS
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.readback import Readback
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training import finite
from snowsplat.training.view_gradient import ViewGradient

#: Initial capacity, in instances per Gaussian. A visible Gaussian has about seven instances, and a
#: view shows only a part of the scene. If the capacity is too small, one step is repeated.
INITIAL_INSTANCES_PER_GAUSSIAN = 4
#: The capacity grows when a step uses more than this fraction of it. So it usually grows before a
#: view exceeds it: the required number differs between views, but changes slowly during training.
GROW_ABOVE = 0.9
#: A new capacity is this multiple of the required instances. This is enough for one densification:
#: it increases the number of Gaussians by at most about a quarter.
GROWTH = 1.3


class StepRunner:
    """Runs training steps: capacity, validity, read-back, repetition and `Diverged`.

    def optimize() -> None:
        splats = project(gaussians, camera, sh_degree)
        with torch.enable_grad():
            image = runner.rasterize(splats, camera, background)
            loss = view_loss(image, photo, background, ssim_weight)
        gradient = runner.backward(loss, splats, camera, sh_degree)
        density.after_backward(step, gaussians, gradient)
        optimizer.step(gaussians, gradient, step)

    loss = runner.run(optimize, step, gaussians, view, photo)
    """

    def __init__(self, gaussians: int, device: torch.device, abs_grad: bool = False) -> None:
        """
        Args:
            gaussians: their initial number, from which the initial capacity is estimated.
            abs_grad: whether the backward pass computes ``abs_grad`` of the splats.
        """
        # The CPU allocates what a frame requires, and ignores the capacity.
        on_cpu = device.type == "cpu"
        instances = sys.maxsize if on_cpu else INITIAL_INSTANCES_PER_GAUSSIAN * gaussians
        self.capacity = Capacity(instances, torch.zeros(1, dtype=torch.int64, device=device))
        self._abs_grad = abs_grad
        self._nonfinite_rows = torch.zeros(len(PARAMETERS), dtype=torch.int32, device=device)
        self._readback = Readback(2 + len(PARAMETERS), device)

    def rasterize(self, splats: Splats2D, camera: Camera, background: Tensor) -> Tensor:
        """Rasterize with the current capacity; gradients flow to ``splats.packed``.

        Args:
            background: (3,) colour in 0..1.

        Returns:
            (H, W, 3) image.
        """
        splats.packed.requires_grad_()
        if self._abs_grad:
            splats.abs_grad = splats.packed.new_zeros(len(splats), 2)
        size = camera.width, camera.height
        image, _, _ = ops.rasterize(splats, *size, background, capacity=self.capacity)
        return image

    def backward(
        self, loss: Tensor, splats: Splats2D, camera: Camera, sh_degree: int
    ) -> ViewGradient:
        """Start the read-back, then run the backward pass from ``loss`` () to the splats."""
        required, instances = self.capacity.required, self.capacity.instances
        self._readback.start(loss, required, self._nonfinite_rows)
        valid = loss.detach().isfinite() & (required <= instances)
        valid &= ~self._nonfinite_rows.any()
        loss.backward()
        return ViewGradient(splats, camera, sh_degree, valid, self._nonfinite_rows)

    def run(
        self,
        optimize: Callable[[], None],
        step: int,
        gaussians: Gaussians,
        view: View,
        photo: LoadedImage,
    ) -> float:
        """Run one step. If the capacity was too small, repeat the step with a larger capacity.

        Args:
            optimize: queues the step, through `rasterize` and `backward`.
            step, gaussians, view, photo: used for the message of an error.

        Returns:
            The loss.

        Raises:
            Diverged: the loss is not finite, or the update of the previous step was not.
        """
        while True:
            optimize()
            # The complete step is queued. A GPU computes it while the CPU waits for the loss.
            loss, required, *nonfinite_rows = self._readback.wait()
            instances = self.capacity.instances
            if required > GROW_ABOVE * instances:
                self.capacity = replace(self.capacity, instances=int(GROWTH * required))
            if required <= instances:
                break
        # The counts were copied before the update of this step, so they are for the previous steps.
        finite.check_updates(step - 1, nonfinite_rows, gaussians)
        finite.check_loss(step, loss, gaussians, view, photo)
        return loss

    def finish(self, step: int, gaussians: Gaussians) -> None:
        """Wait for the device, and check the update of the last step, ``step``.

        Raises:
            Diverged: the update was not finite.
        """
        finite.check_updates(step, self._nonfinite_rows.tolist(), gaussians)

    def reset(self) -> None:
        """Set the counts of skipped rows to 0, after the state of the training was replaced."""
        self._nonfinite_rows.zero_()
