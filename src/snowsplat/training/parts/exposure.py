"""`Exposure`: a gain for each photo and channel, which the training learns together with the scene.

A camera that chooses exposure and white balance for each photo makes the same surface brighter in
one photo than in another. The scene has one colour for it. So the image I is multiplied by the
gains of the photo v, before the two are compared:

    I' = I exp(g_v),      ∂L/∂g_v = Σ ∂L/∂I' I'      over the pixels, for each channel.

The background is not a part of the photo, so the image is rendered over its colour times exp(−g_v).

The gains follow Adam, with the prior ε √(τ² + g²), which is quadratic for small gains and linear
for large ones. After each update, the mean of g over the photos is subtracted. Otherwise scene and
gains could change together, and the colours of the scene would be arbitrary; so they are neutral.

Where a photo is overexposed, it only says that the image is at least as bright; see
`exposed_image`.
"""

from __future__ import annotations

from statistics import pstdev
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from snowsplat.data.photos.decode import LoadedImage
from snowsplat.evaluation.verdict import Reason
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.exposed_image import ExposedImages
from snowsplat.training.parts.exposure_start import LOG_EV, ExposureStart, exposure_start
from snowsplat.training.parts.neutral_photos import NeutralPhotos
from snowsplat.training.parts.part import Part, PartReport, Section
from snowsplat.training.step.batch import Batch, BatchView
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: With a smaller spread, in EV, the gains are not learnt.
LEAST_SPREAD = 0.05
#: With a larger one, in EV, the camera should be set by hand.
_VISIBLE_SPREAD = 0.3
#: The learning rate of the log-gains at the first and at the last step.
_RATE, _LAST_RATE = 5e-3, 5e-4
_BETAS = 0.9, 0.99
_EPSILON = 1e-12
#: ε and τ of the prior.
_PRIOR, _SMALL = 1e-3, 0.3


class Exposure(Part):
    """The gains of the training photos.

    Attributes:
        active: whether gains are learnt.
        log_gains: (V, 3) float32 on the device; all zero if they are not learnt.
        start: (V, 3) the log-gains before the first step, on the CPU.
    """

    name = "exposure"
    recordable = True

    def __init__(self, setting: str) -> None:
        """
        ``setting``: "auto" or "on", see ``TrainConfig.exposure``.
        """
        self._setting = setting
        # (3,) log-gains, with their gradients, of the views that exist: those of this process in
        # the present step, and those of recordings.
        self._present: WeakKeyDictionary[BatchView, Tensor] = WeakKeyDictionary()
        self._images = ExposedImages()

    def prepare(self, run: Run) -> None:
        """Compare the photos, unless a state follows. Then `Run.photos` have equal exposures.

        Raises: UserError: a photo is missing or damaged.
        """
        views, first = run.dataset.train, run.shards.rank == 0
        start = ExposureStart(torch.zeros(len(views), 3), None)
        if not run.resumed:
            start = run.shards.of_first(exposure_start(run.dataset, run.images) if first else None)
        self.active = self._setting == "on" or _differ(start)
        if not run.resumed:
            run.note(_reason(start, self.active))
        self.start = start.log_gains * self.active
        self.log_gains = self.start.to(run.device, copy=True)
        self._mean = torch.zeros_like(self.log_gains)  # the moments of Adam
        self._square = torch.zeros_like(self.log_gains)
        self._updates = torch.zeros(len(views), dtype=torch.int64)
        self._middle = torch.zeros_like(self.log_gains[0])  # the mean of the gains
        run.photos = NeutralPhotos(run.images, views, self.start)

    def continue_with(self, ev: Tensor) -> None:
        """Set the exposures of the first photos: the scene has been trained with these.

        The gains of the others keep their difference to those of the first photos.

        ``ev``: (N, 3) in EV, see `ev`.
        """
        known = (LOG_EV * ev).to(self.log_gains)
        self.log_gains += (known - self.log_gains[: len(known)]).mean(0)
        self.log_gains[: len(known)] = known
        self._middle = self.log_gains.mean(0)

    @property
    def ev(self) -> Tensor:
        """(V, 3) on the CPU: the exposures in EV, relative to their mean; no rows if not learnt."""
        rows = self.log_gains if self.active else self.log_gains[:0]
        return rows.cpu() / LOG_EV

    def background(self, run: Run, view: BatchView, color: Tensor) -> Tensor:
        """The colour (3,) that becomes ``color`` when it is exposed."""
        if not self.active:
            return color
        # If a step is repeated, this replaces the gradient of the last attempt.
        log_gains = self.log_gains.index_select(0, view.row)[0].requires_grad_()
        self._present[view] = log_gains
        if run.config.background == "black":  # saves a pass over the image
            return color
        return color * (-log_gains).exp()

    def image(self, run: Run, view: BatchView, image: Tensor, photo: LoadedImage) -> Tensor:
        """The image (H, W, 3) as the camera of the view exposes it."""
        if not self.active:
            return image
        # Another part may have changed the colours, and a recording is for many photos: then the
        # positions are not remembered.
        same = view.photo is not None and photo.planes is view.photo.planes
        return self._images.exposed(image, self._present[view], photo, view.index if same else None)

    def repeated(self, run: Run, view: BatchView, recorded: BatchView) -> None:
        """See `Part.repeated`."""
        if self.active:
            self._present[view] = self._present[recorded]

    def after_step(self, run: Run, step: int, batch: Batch) -> None:
        """Update the gains of the photos of the batch."""
        if not self.active:
            return
        size, rank = run.shards.size, run.shards.rank
        own = self.log_gains.new_zeros(-(-len(batch) // size), 3)
        for row, view in zip(own, batch[rank::size], strict=False):
            gradient = self._present.pop(view).grad
            assert gradient is not None
            row += gradient
        table = run.shards.table(own.flatten()).view(size, -1, 3)
        rate = _RATE * (_LAST_RATE / _RATE) ** (step / run.schedule.iterations)
        for position, view in enumerate(batch):  # in each round, process r has view r
            self._update(view.index, table[position % size, position // size], rate)
        self.log_gains -= self.log_gains.mean(0) - self._middle

    def _update(self, i: int, gradient: Tensor, rate: float) -> None:
        gain, (b1, b2) = self.log_gains[i], _BETAS
        gradient = gradient + _PRIOR * gain / (_SMALL**2 + gain.square()).sqrt()
        self._updates[i] += 1
        n = int(self._updates[i])
        mean = self._mean[i].lerp_(gradient, 1.0 - b1) / (1.0 - b1**n)
        square = self._square[i].lerp_(gradient.square(), 1.0 - b2) / (1.0 - b2**n)
        gain -= rate * mean / (square.sqrt() + _EPSILON)

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """The exposure of each photo in EV, if gains are learnt."""
        if not self.active:
            return PartReport()
        names = (view.name for view in run.dataset.train)
        ev = dict(zip(names, self.ev.tolist(), strict=True))
        means = tuple(sum(channels) / 3 for channels in ev.values())
        spread = pstdev(means)
        text = message(
            "the exposures of the photos differ by {spread:.1f} EV, which the training corrects",
            spread=spread,
        )
        advice = message("fix the exposure and the white balance of the camera")
        section = Section(
            message("Exposures of the photos"),
            (
                message(
                    "In EV (factors of two of light), relative to their mean, which is the "
                    "exposure of the scene."
                ),
            ),
            means,
            message("exposure, EV"),
        )
        return PartReport(
            reasons=(Reason("good", text, advice),) if spread >= _VISIBLE_SPREAD else (),
            files={"exposure.json": {"unit": "EV", "photos": ev}},
            sections=(section,) if any(means) else (),
            facts=ev,
        )

    def state(self) -> dict[str, Tensor]:
        """The gains and the moments of Adam."""
        return {
            "active": torch.tensor(self.active),
            "start": self.start,
            "log_gains": self.log_gains,
            "mean": self._mean,
            "square": self._square,
            "updates": self._updates,
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part.load`."""
        self.active = bool(tensors["active"])
        self.start.copy_(tensors["start"])
        self.log_gains.copy_(tensors["log_gains"])
        self._mean.copy_(tensors["mean"])
        self._square.copy_(tensors["square"])
        self._updates.copy_(tensors["updates"])


def exposure_hint(run: Run) -> Message | None:
    """A line for a training without gains whose photos differ in exposure; None if they do not.

    Without gains, a scene reproduces the exposure of each photo by veils and by colours that depend
    on the direction, which are wrong between the photos.
    """
    start = exposure_start(run.dataset, run.images)
    if not _differ(start):
        return None
    return message(
        "exposure: {found}; no gains are learnt, because exposure is off: use exposure=auto",
        found=_found(start),
    )


def _differ(start: ExposureStart) -> bool:
    """Whether the photos differ as photos of other exposures do."""
    return start.spread is not None and start.spread >= LEAST_SPREAD and start.everywhere


def _found(start: ExposureStart) -> Message:
    if start.spread is None:
        return message("not known from the points of the dataset or EXIF data")
    found = message(
        "photos differ by {spread:.2f} EV (standard deviation, from {source})",
        spread=start.spread,
        source=start.source,
    )
    if start.spread >= LEAST_SPREAD and not start.everywhere:
        return message(
            "{found}, but not by the same in all parts of the scene, as shiny surfaces do",
            found=found,
        )
    return found


def _reason(start: ExposureStart, active: bool) -> Message:
    found = _found(start)
    if active:
        return message(
            "exposure: {found}; one gain for each photo and channel is learnt", found=found
        )
    return message("exposure: {found}; no gains are learnt", found=found)
