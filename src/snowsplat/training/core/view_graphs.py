"""`ViewGraphs`: queues the gradient of a view on a GPU as recorded CUDA graphs.

A GPU computes the gradient of 200,000 Gaussians in 0.6 ms, but Python needs 2 ms to queue its 60
kernels one by one. A CUDA graph is a recorded sequence of kernels, which is queued by one call. It
repeats the same kernels with the same addresses and numbers. So a recording is used only while all
of these are the same (`_key`): the memory of the Gaussians, the size of the photo, and the memory
of the rasterizer. What differs between the views, their pose, intrinsics, photo, background and
index, is copied to memory that belongs to the recording (`_Inputs`).

There are two graphs, because the CPU reads the loss back between the forward and the backward pass:
see `StepRunner`. Density control and the optimiser are not recorded: they depend on the step.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import RenderOutput, view_of
from snowsplat.training.parts.part import Part
from snowsplat.training.step.batch import BatchView
from snowsplat.training.step.step_runner import StepRunner, Summary
from snowsplat.training.step.view_gradient import ViewGradient
from snowsplat.util.messages import Message, message

#: A recording keeps the memory of its splats and their gradient: 132 bytes per Gaussian.
MOST_RECORDINGS = 4


@dataclass(frozen=True)
class Objective:
    """How a view becomes a loss.

    Attributes:
        background: a view -> the colour (3,) over which it is rendered.
        loss: a view, its rendering, and the photo that it is compared with -> the loss ().
        repeated: called after a recording was queued for a view, with this view and that of the
            recording, which the two functions got.
        version: a recording is for one of them.
    """

    background: Callable[[BatchView], Tensor]
    loss: Callable[[BatchView, RenderOutput, LoadedImage], Tensor]
    repeated: Callable[[BatchView, BatchView], None]
    version: Hashable


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
    """Whether each part that takes part between the projection and the loss permits recordings.

    The Python code of a part runs when it is recorded, but not in later steps.
    """
    hooks = ("background", "image", "loss")
    fixed = [type(part) for part in parts if not (part.idle or part.recordable)]
    return all(getattr(kind, hook) is getattr(Part, hook) for kind in fixed for hook in hooks)


class _Inputs:
    """Memory that belongs to a recording.

    Attributes:
        view: stands for all views; see `BatchView`.
        photo: what the image is compared with.
        intrinsics: (4,) float64: see `ops.View`.
    """

    def __init__(self, view: BatchView, photo: LoadedImage, dtype: torch.dtype) -> None:
        pose = torch.empty_like(view.camera.cam_from_world, dtype=dtype)
        mask = None if photo.mask is None else torch.empty_like(photo.mask)
        self.view = replace(
            view,
            index=-1,
            camera=replace(view.camera, cam_from_world=pose),
            photo=None,
            background=torch.empty_like(view.background),
            row=torch.empty_like(view.row),
        )
        self.photo = LoadedImage(torch.empty_like(photo.planes), mask)
        self.intrinsics = torch.empty(4, dtype=torch.float64, device=pose.device)
        # The GPU has copied it when the step ends, at the latest.
        self._numbers = torch.zeros(4, dtype=torch.float64, pin_memory=pose.device.type == "cuda")

    def copy(self, view: BatchView, photo: LoadedImage) -> None:
        self.view.camera.cam_from_world.copy_(view.camera.cam_from_world)
        self.photo.planes.copy_(photo.planes)
        if self.photo.mask is not None and photo.mask is not None:
            self.photo.mask.copy_(photo.mask)
        self.view.background.copy_(view.background)
        self.view.row.copy_(view.row)
        c = view.camera
        numbers = [c.fx, c.fy, c.cx, c.cy]
        if self._numbers.tolist() != numbers:
            self._numbers.copy_(torch.tensor(numbers, dtype=torch.float64))
            self.intrinsics.copy_(self._numbers, non_blocking=True)


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
        objective: Objective,
        record: Recorder,
    ) -> None:
        self.inputs = inputs

        def forward() -> None:
            view = inputs.view
            projection = view_of(gaussians, view.camera, sh_degree)
            self.splats = ops.project(gaussians, replace(projection, intrinsics=inputs.intrinsics))
            with torch.enable_grad():
                background = objective.background(view)
                rendered = runner.rasterize(self.splats, view.camera, background)
                self._loss = objective.loss(view, rendered, inputs.photo)
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
        objective: Objective,
    ) -> ViewGradient | None:
        """As `batch_gradients` for one view; None if there is no recording for it.

        A recording is made when two views in a row have the same key: the first one has then loaded
        the kernels, and a recording that is used once would not pay.

        Args:
            photo: what the image is compared with.
        """
        if self._record is None:
            return None
        memory = tuple((p.data_ptr(), p.shape) for p in gaussians.parameters().values())
        if memory != self._memory:
            self._memory = memory
            if self._recordings:
                self._recordings.clear()
                self._record.forget()
        key = (_key(gaussians, view, photo, sh_degree, runner), objective.version)
        repeated, self._last = (memory, key) == self._last, (memory, key)
        recording = self._recordings.pop(key, None)
        if recording is None:
            if not repeated:
                return None
            if len(self._recordings) == MOST_RECORDINGS:
                del self._recordings[next(iter(self._recordings))]
            inputs = _Inputs(view, photo, gaussians.means.dtype)
            try:
                recording = _Recording(
                    inputs, gaussians, sh_degree, runner, objective, self._record
                )
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
        objective.repeated(view, recording.inputs.view)
        return runner.gradient(recording.splats, view.camera, sh_degree)


def _key(
    gaussians: Gaussians, view: BatchView, photo: LoadedImage, sh_degree: int, runner: StepRunner
) -> Any:
    """All numbers and sizes that a recording repeats, except for the memory of the Gaussians."""
    c = view.camera
    return (
        (c.width, c.height, c.near),
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
