"""`ViewGraphs`: queues the gradient of a view on a GPU as recorded CUDA graphs.

A GPU computes the gradient of 200,000 Gaussians in 0.6 ms, but Python needs 2 ms to queue its 60
kernels one by one. A CUDA graph is a recorded sequence of kernels, which is queued by one call. It
repeats the same kernels with the same addresses and numbers. So a recording is used only while all
of these are the same (`_key`): the memory of the Gaussians, the intrinsics of the camera, the size
of the photo, and the memory of the rasterizer. What differs between the views, their pose, photo
and background, is copied to memory that belongs to the recording (`_Inputs`).

There are two graphs, because the CPU reads the loss back between the forward and the backward pass:
see `StepRunner`. Density control and the optimiser are not recorded: they depend on the step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.training.parts.part import Part
from snowsplat.training.step.batch import BatchView
from snowsplat.training.step.step_runner import StepRunner, Summary
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.messages import Message, message

#: A recording keeps the memory of its splats and their gradient: 132 bytes per Gaussian.
MOST_RECORDINGS = 4

Loss = Callable[[Tensor, LoadedImage, Tensor], Tensor]


class Recorder(Protocol):
    """Records kernels, so that they can be queued without the Python code that queued them."""

    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        """Record the kernels that ``work`` queues, without running them; the returned function
        queues them again."""
        ...

    def forget(self) -> None:
        """All recordings were deleted: give their memory back."""
        ...


def recordable(parts: Sequence[Part]) -> bool:
    """Whether no part takes part between the projection and the loss.

    The Python code of such a part would run when it is recorded, but not in later steps.
    """
    hooks = ("background", "image", "loss")
    active = [type(part) for part in parts if not part.idle]
    return all(getattr(kind, hook) is getattr(Part, hook) for kind in active for hook in hooks)


@dataclass
class _Inputs:
    """Memory that belongs to a recording."""

    camera: Camera
    photo: LoadedImage
    background: Tensor

    @classmethod
    def like(cls, view: BatchView, photo: LoadedImage, dtype: torch.dtype) -> _Inputs:
        camera = view.camera
        pose = torch.empty_like(camera.cam_from_world, dtype=dtype)
        mask = None if photo.mask is None else torch.empty_like(photo.mask)
        return cls(
            replace(camera, cam_from_world=pose),
            LoadedImage(torch.empty_like(photo.planes), mask),
            torch.empty_like(view.background),
        )

    def copy(self, view: BatchView, photo: LoadedImage) -> None:
        self.camera.cam_from_world.copy_(view.camera.cam_from_world)
        self.photo.planes.copy_(photo.planes)
        if self.photo.mask is not None and photo.mask is not None:
            self.photo.mask.copy_(photo.mask)
        self.background.copy_(view.background)


class _Recording:
    """The forward and the backward pass of a view."""

    splats: Splats2D
    summary: Summary
    _loss: Tensor | None

    def __init__(
        self,
        inputs: _Inputs,
        gaussians: Gaussians,
        sh_degree: int,
        runner: StepRunner,
        loss: Loss,
        record: Recorder,
    ) -> None:
        self.inputs = inputs

        def forward() -> None:
            camera, background = inputs.camera, inputs.background
            self.splats = project(gaussians, camera, sh_degree)
            with torch.enable_grad():
                image = runner.rasterize(self.splats, camera, background).image
                self._loss = loss(image, inputs.photo, background)
            self.summary = runner.summary([self._loss.detach()], runner.capacity.required)

        def backward() -> None:
            assert self._loss is not None
            self._loss.backward()
            self._loss = None  # and with it the image and the tiles

        self.forward = record(forward)
        self.backward = record(backward)


class ViewGraphs:
    """The recordings of the present Gaussians. The least recently used one is replaced."""

    def __init__(self, record: Recorder, note: Callable[[Message], None]) -> None:
        """
        ``note``: takes a line for the user.
        """
        self._record: Recorder | None = record
        self._note = note
        self._recordings: dict[Any, _Recording] = {}
        self._memory: Any = None  # of the Gaussians
        self._last: Any = None  # key of the last view

    def gradient(
        self,
        gaussians: Gaussians,
        view: BatchView,
        photo: LoadedImage,
        sh_degree: int,
        runner: StepRunner,
        loss: Loss,
    ) -> ViewGradient | None:
        """As `batch_gradients` for one view; None if there is no recording for it.

        A recording is made when two views in a row have the same key: the first one has then loaded
        the kernels, and a recording that is used once would not pay.

        Args:
            photo: what the image is compared with.
            loss: takes an image (H, W, 3), the photo and the background (3,). Another object has
                other recordings.
        """
        if self._record is None:
            return None
        memory = tuple((p.data_ptr(), p.shape) for p in gaussians.parameters().values())
        if memory != self._memory:
            self._memory = memory
            if self._recordings:
                self._recordings.clear()
                self._record.forget()
        key = (_key(gaussians, view, photo, sh_degree, runner), loss)
        repeated, self._last = (memory, key) == self._last, (memory, key)
        recording = self._recordings.pop(key, None)
        if recording is None:
            if not repeated:
                return None
            if len(self._recordings) == MOST_RECORDINGS:
                del self._recordings[next(iter(self._recordings))]
            inputs = _Inputs.like(view, photo, gaussians.means.dtype)
            try:
                recording = _Recording(inputs, gaussians, sh_degree, runner, loss, self._record)
            except RuntimeError as error:  # for example, the memory does not suffice
                self._record = None
                self._recordings.clear()
                reason = (str(error).splitlines() or ["no reason is known"])[0]
                self._note(
                    message(
                        "training continues without CUDA graphs, more slowly: {reason}",
                        reason=reason,
                    )
                )
                return None
        self._recordings[key] = recording  # the most recently used one is the last
        recording.inputs.copy(view, photo)
        recording.forward()
        runner.send(recording.summary)
        recording.backward()
        return runner.gradient(recording.splats, view.camera, sh_degree)


def _key(
    gaussians: Gaussians, view: BatchView, photo: LoadedImage, sh_degree: int, runner: StepRunner
) -> Any:
    """All numbers and sizes that a recording repeats, except for the memory of the Gaussians."""
    c = view.camera
    return (
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.near),
        (photo.planes.shape, photo.mask is None, view.background.dtype),
        (sh_degree, gaussians.antialiased, runner, runner.capacity.instances),
        torch.are_deterministic_algorithms_enabled(),
    )


class GraphRecorder:
    """A `Recorder` of CUDA graphs, which share memory, because they never run at the same time."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._pool = torch.cuda.graph_pool_handle()
        # Not the default stream, where nothing can be recorded. The backward pass runs on the
        # stream of the forward pass, so both are recorded on the same one.
        self._stream = torch.cuda.Stream(device)

    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        """See `Recorder`."""
        # A graph cannot use the memory that torch keeps after a step without graphs.
        torch.cuda.empty_cache()
        graph, present = torch.cuda.CUDAGraph(), torch.cuda.current_stream(self._device)
        self._stream.wait_stream(present)
        with torch.cuda.stream(self._stream):
            # Meanwhile other threads decode photos, and may allocate memory.
            graph.capture_begin(self._pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        present.wait_stream(self._stream)
        return graph.replay

    def forget(self) -> None:
        """See `Recorder`."""
        # torch does not accept a pool again after its last graph was deleted.
        self._pool = torch.cuda.graph_pool_handle()
        torch.cuda.empty_cache()
