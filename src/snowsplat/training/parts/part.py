"""`Part`: what takes part in a training besides the loop.

A training is a loop (`trainer.Trainer`) and a list of parts. The loop calls the methods of the
parts in the order of the list, and `Part.gradients` in the reverse order. Every option of
`TrainConfig` that is more than a number is a part in its own file; `parts_of` makes the list for a
configuration. A user can add more:

    class DepthLoss(Part):
        with_depth = True

        def loss(self, run, view, rendered):
            return 0.1 * (rendered.depth - self.depths[view.index]).abs().mean()

    Trainer(dataset, config, parts=[*parts_of(config), DepthLoss()])

A part does not know any other part. What several parts need is in the `Run`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from PIL import Image
from torch import Tensor

from snowsplat.data.dataset import Points
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.evaluation.verdict import Reason
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import RenderOutput
from snowsplat.training.step.batch import Batch, BatchView, Gradients
from snowsplat.util.messages import Message
from snowsplat.util.overrides import check_overrides

if TYPE_CHECKING:  # these modules import this one
    from snowsplat.training.core.run import Run

#: The opacity of a removed Gaussian, as a logit. It is too transparent to be visible, so the
#: optimiser does not restore it, and density control removes it or uses it elsewhere.
REMOVED = -10.0


@dataclass(frozen=True)
class Section:
    """A section of the page about the training.

    Attributes:
        title: of the section.
        text: its sentences.
        values: a number for each training photo, which a chart shows; may be empty.
        label: of these numbers; None: there are none.
        masks: by the name of the training photo, of its size: 0 where the page tints the photo.
    """

    title: Message
    text: tuple[Message, ...]
    values: tuple[float, ...] = ()
    label: Message | None = None
    masks: Mapping[str, Image.Image] = field(default_factory=dict)


@dataclass(frozen=True)
class PartReport:
    """Everything may be empty.

    Attributes:
        lines: clauses without a full stop, for the terminal and the page.
        reasons: for the verdict on the scene; among those of a grade, the worst one is first.
        files: by their paths in the output folder: values of JSON, or images.
        sections: of the page.
        facts: what `sections` say, for programs.
    """

    lines: tuple[Message, ...] = ()
    reasons: tuple[Reason, ...] = ()
    files: Mapping[str, Any] = field(default_factory=dict)
    sections: tuple[Section, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


class Part:
    """The base class of all parts. A part overrides the methods that it needs.

    A part belongs to one training run. Methods that return something return their argument, or
    nothing, if they are not overridden. Autograd is off, except in `background`, `target`, `image`,
    `loss` and `regularizer`. With several processes, all of them call the same methods in the same
    order, but `background`, `target`, `image` and `loss` only in the process that blends the view:
    these must not call `Run.render` or methods of ``run.shards``. On a GPU, these four may be
    called twice for a view. A GPU is faster if each part that is not `idle` and overrides
    `background`, `image` or `loss` is `recordable`: see `training.core.view_graphs`.

    Attributes:
        name: of the part in checkpoints and messages; default: the name of the class.
        with_depth: whether the part uses ``rendered.depth``. Rendering it takes time.
        abs_grad: whether the part uses ``gradient.splats.abs_grad``.
        idle: whether `background`, `image` and `loss` have no effect in this training. All three
            are set at the latest in `prepare`.
        recordable: whether the kernels of `background`, `image` and `loss` may be recorded in one
            step, and repeated in other steps for other views. Their Python code does not run then.
            So what differs between views must come from tensors: those of their arguments, whose
            memory a recording has for itself (``view.row`` is the index on the device), and those
            of the part, which must always be at the same place in memory. See also `repeated`.
    """

    name: ClassVar[str]
    recordable: ClassVar[bool] = False
    with_depth: bool = False
    abs_grad: bool = False
    idle: bool = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in vars(cls):
            cls.name = cls.__name__
        check_overrides(cls, Part)

    # Once, before the first step

    def prepare(self, run: Run) -> None:
        """Called before the first Gaussians exist, for example to look at the photos."""

    def points(self, run: Run, points: Points) -> Points:
        """The points (P,) from which the first Gaussians are made, on the CPU; in process 0 only.
        Not called if the training is resumed, or starts from given Gaussians.
        """
        return points

    def begin(self, run: Run) -> None:
        """Called when the first Gaussians exist, before the state of a checkpoint is loaded."""

    # In each step, in this order

    def between(self, run: Run) -> None:
        """Called between two steps, after step ``run.step``: may change the Gaussians in place,
        assign ``run.gaussians``, ``run.cameras`` or ``run.queue.order``, stretch ``run.schedule``.

        If it adds, removes or reorders Gaussians, it must do the same in ``run.optimizer``, by
        `Adam.select`.
        """

    def background(self, run: Run, view: BatchView, color: Tensor) -> Tensor:
        """The colour (3,) over which a view is rendered; at first, ``view.background``."""
        return color

    def target(self, run: Run, view: BatchView, photo: LoadedImage) -> LoadedImage:
        """What the image of a view is compared with; at first, ``view.photo``."""
        return photo

    def image(self, run: Run, view: BatchView, image: Tensor, photo: LoadedImage) -> Tensor:
        """What is compared with the photo: (H, W, 3) in 0..1; at first, ``rendered.image``.

        Args:
            photo: the result of `target`.
        """
        return image

    def loss(self, run: Run, view: BatchView, rendered: RenderOutput) -> Tensor | None:
        """A term () that is added to the loss of a view. It can be differentiated with respect to
        the image, the alpha and, if `with_depth`, the depth.
        """
        return None

    def repeated(self, run: Run, view: BatchView, recorded: BatchView) -> None:
        """Called after the kernels of `background`, `image` and `loss` were queued again for
        ``view``, and those of their backward pass. ``recorded``: the view with which the methods
        were called when they were recorded: tensors that were made then have new values.
        """

    def gradients(self, run: Run, step: int, batch: Batch, gradients: Gradients) -> None:
        """Called before the optimiser: may read or change the gradient of each view of the batch,
        ``gradient.packed_grad``, in place. It must not wait for a GPU, and must not change the
        state of the part if ``gradient.valid`` is False on the device; see `ViewGradient`.
        """

    def regularizer(self, run: Run, gaussians: Gaussians) -> Tensor | None:
        """A term () that is added to the loss of the batch. It can be differentiated with respect
        to the parameters of the Gaussians. With several processes, each has some of the Gaussians,
        and the terms are added. If a part has a regulariser, ``TrainConfig.visible_only`` has no
        effect: all Gaussians are updated in each step.
        """
        return None

    def after_step(self, run: Run, step: int, batch: Batch) -> None:
        """Called after the optimiser, when the step is known to be valid."""

    # At the end, in process 0

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """What the part has to report.

        ``gaussians``: the scene: those of all processes.
        Raises: UserError: a photo is missing or damaged.
        """
        return PartReport()

    # In checkpoints

    def state(self) -> dict[str, Tensor]:
        """The state on which the next steps depend, by name. The tensors are not copied. They are
        finite, and the same in all processes.
        """
        return {}

    def row_state(self) -> dict[str, Tensor]:
        """Further state, with one row for each Gaussian of this process. The part keeps the rows in
        the order of the Gaussians; ``run.rows`` does this for tensors that are stored there.
        """
        return {}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Copy what `state` and `row_state` returned."""
