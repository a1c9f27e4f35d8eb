"""`Run`: what the loop and the parts of a training share."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.data.photos.image_loader import ImageLoader, Photos, available_memory
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import seen_from
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.run_state import RESERVED, load_state, state_tensors
from snowsplat.training.core.view_graphs import GraphRecorder, ViewGraphs, recordable
from snowsplat.training.core.view_queue import Background, ViewQueue
from snowsplat.training.parts.list import parts_of
from snowsplat.training.parts.part import Part
from snowsplat.training.processes.shards import ALONE, Shards, sharded_render
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.training.step.losses import view_loss
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.step_runner import StepRunner
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message
from snowsplat.util.process import single_threaded

#: There is one random generator for each kind of random choice, so that additional choices of one
#: kind do not change the others. The names are part of the checkpoint format. The index of a name
#: determines the seed of its generator, so the order must not change.
GENERATORS = ("start", "views", "background", "density")

#: image (H, W, 3), photo, background (3,) -> loss (), differentiable in the image.
Loss = Callable[[Tensor, LoadedImage, Tensor], Tensor]

PartKind = TypeVar("PartKind", bound=Part)


class Cameras(Protocol):
    """The present cameras of the views."""

    def camera(self, view: int) -> Camera:
        """That of a training view, on the device."""
        ...

    def views(self) -> list[View]:
        """The training views with their present cameras, on the CPU."""
        ...

    def test_views(self) -> list[View]:
        """The test views with their present cameras, on the CPU."""
        ...


class DatasetCameras:
    """The cameras of the dataset, unchanged."""

    def __init__(self, dataset: Dataset, device: torch.device) -> None:
        self.dataset = dataset
        self.on_device = [view.camera.to(device) for view in dataset.train]

    def camera(self, view: int) -> Camera:
        """See `Cameras`."""
        return self.on_device[view]

    def views(self) -> list[View]:
        """See `Cameras`."""
        return self.dataset.train

    def test_views(self) -> list[View]:
        """See `Cameras`."""
        return self.dataset.test


class Run:
    """The state of a training run. `Trainer` is a run with its loop; parts get it as an argument.

    Attributes:
        config, schedule: the settings, and the number of steps, which parts may stretch.
        step: the number of completed steps.
        within_step: True during a step. It stays True if an error or a second Ctrl-C interrupts a
            step: the state is then inconsistent and must not be saved.
        gaussians: the scene after ``step`` steps, on ``device``; those of this process.
        optimizer: its moments have the same rows.
        parts: see `Part`.
        loss: compares an image with a photo.
        dataset_cameras: those of the training views, on the device.
        cameras: the present cameras of the views; a part may replace this object.
        images: loads the photos of the training views.
        photos: the same photos; a part that corrects them may replace this object.
        background: the colour behind the scene.
        queue: chooses the views of the next steps.
        runner: runs a step, and repeats it if the memory of the rasterizer was too small.
        graphs: queues the gradient of a view on a GPU; None if it is computed without graphs.
        generators: one random generator for each of `GENERATORS`.
        render: renders the Gaussians of all processes; every process must call it.
        shards: the processes.
        resumed: whether the state of a checkpoint replaces the first Gaussians.
        initial: the given first Gaussians, or None.
        note: takes a line for the user.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: TrainConfig,
        schedule: Schedule | None = None,
        device: torch.device | None = None,
        state: dict[str, Tensor] | None = None,
        initial: Gaussians | None = None,
        shards: Shards = ALONE,
        *,
        parts: Sequence[Part] | None = None,
        loss: Loss | None = None,
        note: Callable[[Message], None] = lambda line: None,
    ) -> None:
        """
        Args:
            schedule: the schedule of a resumed training run; default: ``config.iterations`` steps.
            device: the device for training; default: the CPU.
            state: the state of a resumed training run; see `load_state`.
            initial: the Gaussians to start from, of the SH degree of ``config``; default:
                `initial_gaussians`.
            shards: the processes that train together. Each of them creates a trainer with the same
                arguments, and calls the same methods.
            parts: what takes part in the training; default: ``parts_of(config)``.
            loss: compares an image with a photo; default: `view_loss`.
            note: takes a line for the user, for example about what a part has found.

        Raises:
            UserError: the dataset has no training views, the device cannot train with these
                settings, or some points are so far apart that
                float32 cannot represent their Gaussians; two parts have the same name; or the state
                is not valid, see `load_state`.
        """
        if not dataset.train:
            raise UserError("the dataset has no training views; check its folder and its split")
        _refuse_what_is_missing(device, config, shards)
        self.dataset = dataset
        sizes = sorted(view.camera.width * view.camera.height for view in dataset.train)
        self.config = config = config.capped(sizes[len(sizes) // 2], len(sizes))
        self.schedule = replace(schedule or Schedule(config.iterations), batch=config.batch)
        self.shards, self.note = shards, note
        self.resumed, self.initial = state is not None, initial
        self.step, self.within_step = 0, False
        self.device = device or torch.device("cpu")
        self.render = sharded_render(shards)
        self.generators = {
            name: torch.Generator().manual_seed(4 * config.seed + i)
            for i, name in enumerate(GENERATORS)
        }
        self.background = Background(config.background, self.generators["background"], self.device)
        memory = config.image_memory or available_memory(self.device) // (2 * shards.in_memory)
        self.images = ImageLoader(
            dataset.train,
            background=self.background.fixed,
            budget_bytes=memory,
            device=self.device,
        )
        self.photos: Photos = self.images
        if self.images.decodes_once and shards.size == 1:
            self.images.prefetch(dataset.train)  # the start needs most of them
        fixed = DatasetCameras(dataset, self.device)
        self.dataset_cameras: Sequence[Camera] = fixed.on_device
        self.cameras: Cameras = fixed
        self.queue = ViewQueue(
            dataset.train,
            lambda view: self.cameras.camera(view),
            self.images,
            self.background,
            self.downscale_at,
            self.generators["views"],
            config.batch,
            shards,
        )
        usual = partial(view_loss, ssim_weight=config.ssim_weight)
        self.has_own_loss = loss is not None
        self._first_loss = loss or usual
        huber = partial(usual, huber_weight=config.huber_weight) if config.huber_weight else usual
        self._last_loss = loss or huber
        self.parts = _with_valid_names(parts_of(config) if parts is None else parts)
        self._begin()
        if state is not None:
            self.load_state(state)

    @property
    def loss(self) -> Loss:
        """Compares an image with a photo in the present step. It is replaced once at most."""
        last = self.step >= self.schedule.step_of(self.config.huber_from)
        return self._last_loss if last else self._first_loss

    def _begin(self) -> None:
        """Prepare the parts, and create the first Gaussians and what belongs to them."""
        config, parts = self.config, self.parts
        for part in parts:
            part.prepare(self)
        first = self.shards.scattered(self._first())
        initial = None if self.initial is None else self.initial.metres_per_unit
        self.gaussians = replace(
            first,
            antialiased=config.antialias,
            origin=self.dataset.origin,
            metres_per_unit=initial or self.dataset.metres_per_unit,
        )
        # A regulariser acts on all Gaussians, not only on those that a view shows.
        self.optimizer = Adam(
            self.gaussians,
            config.learning_rates,
            schedule=self.schedule,
            extent=self.dataset.extent,
            views=len(self.dataset.train),
            beta1=config.beta1,
            visible_only=config.visible_only and not regularizing(parts),
            shards=self.shards,
        )
        self.runner = StepRunner(
            len(self.gaussians),
            self.device,
            any(part.abs_grad for part in parts),
            config.batch,
            self.shards,
            with_depth=any(part.with_depth for part in parts),
        )
        self.graphs: ViewGraphs | None = None
        one_view = self.device.type == "cuda" and self.shards.size == 1 and config.batch == 1
        if one_view and recordable(parts) and not self.has_own_loss:
            self.graphs = ViewGraphs(GraphRecorder(self.device), self.note)
        self.count()
        for part in parts:
            part.begin(self)

    def _first(self) -> Gaussians | None:
        """The first Gaussians, in process 0."""
        if self.shards.rank != 0:
            return None
        if self.initial is not None:
            return seen_from(self.initial, self.dataset.origin).clone().to(self.device)
        # The Gaussians of a resumed training run are replaced by those of the state.
        config = replace(self.config, init="points") if self.resumed else self.config
        with single_threaded():
            return initial_gaussians(
                self.dataset,
                config,
                self.photos,
                self.generators["start"],
                self.device,
                self._adapted if not self.resumed else lambda points: points,
            )

    def _adapted(self, points: Points) -> Points:
        for part in self.parts:
            points = part.points(self, points)
        return points

    def part(self, kind: type[PartKind]) -> PartKind | None:
        """The part of this class, or None if none takes part in the training."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    @property
    def rows(self) -> dict[str, Tensor]:
        """Tensors with one row for each Gaussian of this process, by name. They follow all changes
        of the rows (new Gaussians have zeros), and are part of checkpoints. A part adds them in
        `Part.begin`.
        """
        return self.optimizer.rows

    @property
    def total(self) -> int:
        """The number of Gaussians of all processes."""
        return len(self.gaussians) if self.shards.size == 1 else self._total

    def count(self) -> None:
        """Count the Gaussians of all processes, after their number may have changed."""
        self._total = self.shards.total(len(self.gaussians))

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics in use after ``step`` steps."""
        return self.config.sh_degree_at(self.step)

    @property
    def excluded(self) -> tuple[int, ...]:
        """Indices of the training views that are not used any more."""
        return self.queue.excluded

    @property
    def refines_cameras(self) -> bool:
        """Whether a part has replaced the cameras of the dataset."""
        return not isinstance(self.cameras, DatasetCameras)

    def downscale_at(self, step: int) -> int:
        """The factor by which the photos are reduced at a step."""
        return self.config.downscale_at(step, self.schedule)

    def state_tensors(self) -> dict[str, Tensor]:
        """The state on which the next steps depend, besides dataset, configuration and schedule.

        The tensors are not copied. With several processes, process 0 gets the rows of all of them;
        the others get no rows.
        """
        return state_tensors(self)

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy a state of `state_tensors`, from a run with the same dataset and configuration.

        Raises:
            UserError: the state has another density control, SH degree, dataset, parts or loss, or
                is not finite.
        """
        load_state(self, tensors)
        self.count()


def _refuse_what_is_missing(
    device: torch.device | None, config: TrainConfig, shards: Shards
) -> None:
    """Raises UserError: the device has no kernels for one of the settings."""
    if device is None or device.type != "webgpu":
        return
    if config.refine_poses:
        raise UserError("--refine-poses: the device webgpu cannot refine poses; use cpu or cuda")
    if config.batch > 1:
        raise UserError("--batch: the device webgpu takes one photo per step; use cpu or cuda")
    if shards.size > 1:
        raise UserError("--processes: the device webgpu trains in one process; use cpu or cuda")


def _with_valid_names(parts: Sequence[Part]) -> list[Part]:
    """The parts. Raises UserError: the names of two parts are the same, or a name is reserved."""
    names = [part.name for part in parts]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UserError(
            "two parts have the name {twice!r}; set `name` of one of them", twice=min(twice)
        )
    if bad := [name for name in names if name in RESERVED or "." in name or not name]:
        raise UserError("a part cannot have the name {bad!r}; set another `name`", bad=bad[0])
    return list(parts)


def regularizing(parts: Sequence[Part]) -> list[Part]:
    """The parts that override `Part.regularizer`."""
    return [part for part in parts if type(part).regularizer is not Part.regularizer]


def add_regularizers(run: Run) -> None:
    """Add the gradients of `Part.regularizer` of all parts to ``.grad`` of the parameters.

    The optimiser adds ``.grad`` to the gradient of the photos, and clears it.
    """
    used = regularizing(run.parts)
    if not used:
        return
    leaves = run.gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    with torch.enable_grad():
        terms = [part.regularizer(run, leaves) for part in used]
        for term in terms:
            if term is not None and term.requires_grad:
                term.backward()
    leaf_of = leaves.parameters()
    for name, parameter in run.gaussians.parameters().items():
        gradient = leaf_of[name].grad
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
