"""`ViewQueue`: the training views in random order, with their photos, which are decoded ahead, and
the background of each step.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.camera import Camera
from snowsplat.training.processes.shards import Shards
from snowsplat.training.step.batch import BatchView

#: Background colours by name; "random" is drawn in each step.
FIXED_BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
#: The order of the views is drawn at least this number of steps in advance, so that other threads
#: can decode their photos before they are needed.
LOOKAHEAD = 16


class Background:
    """The background of ``TrainConfig.background``.

    Attributes:
        fixed: RGB in 0..1; None: another colour in each step.
        evaluation: (3,) on the device: the colour for evaluations; black replaces a random one.
    """

    def __init__(self, name: str, generator: torch.Generator, device: torch.device) -> None:
        """
        Args:
            name: of `FIXED_BACKGROUNDS`, or "random".
            generator: draws the random colours, on the CPU.
        """
        self.fixed = FIXED_BACKGROUNDS.get(name)
        self.evaluation = torch.tensor(self.fixed or FIXED_BACKGROUNDS["black"], device=device)
        self._generator = generator

    def draw(self) -> Tensor:
        """(3,) on the device: the colour of the next view."""
        if self.fixed is not None:
            return self.evaluation
        color = torch.rand(3, generator=self._generator)
        return color.to(self.evaluation.device, non_blocking=True)


@dataclass(eq=False)
class ViewQueue:
    """Chooses the views of each step. Each view is chosen once in an epoch, in random order.

    Attributes:
        camera_of: the present camera of a view, on the device.
        images: loads the photos of the views.
        downscale_at: the factor by which images are reduced at a step.
        generator: draws the order, on the CPU.
        batch: the number of views of an update.
        shards: the processes; each loads only the photos of the views that it blends.
        order: indices of the views of the next steps.
        excluded: indices of the views that are not used any more.
    """

    views: Sequence[View]
    camera_of: Callable[[int], Camera]
    images: ImageLoader
    background: Background
    downscale_at: Callable[[int], int]
    generator: torch.Generator
    batch: int
    shards: Shards
    order: list[int] = field(default_factory=list)
    excluded: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        device = self.background.evaluation.device
        self._rows = torch.arange(len(self.views), device=device)

    def take(self, after: int, step: int) -> list[BatchView]:
        """The views of the steps ``after`` + 1 to ``step``, at the resolution of the last one.

        Raises: UserError: a photo is missing or damaged.
        """
        downscale = self.downscale_at(step)
        ahead = max(LOOKAHEAD, self.batch)
        if len(self.order) <= ahead:
            while len(self.order) <= ahead:
                order = torch.randperm(len(self.views), generator=self.generator).tolist()
                self.order += [i for i in order if i not in self.excluded]
            self._prefetch(downscale)
        elif downscale != self.downscale_at(after):
            self._prefetch(downscale)
        return [self._view(position, downscale) for position in range(step - after)]

    def _view(self, position: int, downscale: int) -> BatchView:
        """Remove the next view from the order; ``position``: its position in the batch."""
        i = self.order.pop(0)
        own = position % self.shards.size == self.shards.rank
        photo = self.images.get(self.views[i], downscale) if own else None
        camera = self.camera_of(i).downscaled(downscale)
        row = self._rows[i : i + 1]
        return BatchView(i, self.views[i], camera, photo, self.background.draw(), row)

    def exclude(self, indices: Iterable[int], after: int) -> None:
        """Do not use these views in the steps that follow ``after``."""
        self.excluded = tuple(indices)
        self.continue_with([i for i in self.order if i not in self.excluded], after)

    def continue_with(self, order: list[int], after: int) -> None:
        """Replace the order of the views of the steps that follow ``after``."""
        self.order = order
        self._prefetch(self.downscale_at(after + 1))

    def _prefetch(self, downscale: int) -> None:
        own = [
            self.views[i]
            for position, i in enumerate(self.order)
            if position % self.batch % self.shards.size == self.shards.rank
        ]
        self.images.prefetch(own, downscale)
