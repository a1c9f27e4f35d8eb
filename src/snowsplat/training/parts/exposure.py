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

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset
from snowsplat.data.decode import LoadedImage
from snowsplat.data.image_loader import Photos
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.parts.exposed_image import ExposedImages
from snowsplat.training.parts.exposure_start import GAMMA, ExposureStart, exposure_start
from snowsplat.training.processes.shards import Shards

#: With a smaller spread, in EV, the gains are not learnt.
LEAST_SPREAD = 0.05
#: The learning rate of the log-gains at the first and at the last step.
_RATE, _LAST_RATE = 5e-3, 5e-4
_BETAS = 0.9, 0.99
_EPSILON = 1e-12
#: ε and τ of the prior.
_PRIOR, _SMALL = 1e-3, 0.3


class Exposure:
    """The gains of the training photos.

    Attributes:
        active: whether gains are learnt.
        log_gains: (V, 3) float32 on the device; all zero if they are not learnt.
        start: (V, 3) the log-gains before the first step, on the CPU.
        reason: why they are learnt or not, as a line for the user; empty if the setting is "off".
    """

    def __init__(
        self,
        setting: str,
        dataset: Dataset,
        images: Photos,
        schedule: Schedule,
        device: torch.device,
        shards: Shards,
        resumed: bool,
        black: bool = False,
    ) -> None:
        """
        Args:
            setting: "auto", "on" or "off", see ``TrainConfig.exposure``.
            resumed: whether `load_state` follows, so that the photos need not be compared.
            black: whether each background is black, which saves a pass over the image.

        Raises:
            UserError: a photo is missing or damaged.
        """
        start = ExposureStart(torch.zeros(len(dataset.train), 3), None)
        if setting != "off" and not resumed:
            start = shards.of_first(exposure_start(dataset, images) if not shards.rank else None)
        learnt = start.spread is not None and start.spread >= LEAST_SPREAD
        self.active = setting == "on" or (setting == "auto" and learnt)
        self.reason = "" if setting == "off" or resumed else _reason(start, self.active)
        self.start = start.log_gains * self.active
        self.log_gains = self.start.to(device, copy=True)
        self._mean = torch.zeros_like(self.log_gains)  # the moments of Adam
        self._square = torch.zeros_like(self.log_gains)
        self._updates = torch.zeros(len(dataset.train), dtype=torch.int64)
        self._setting = setting
        self._black = black
        self._schedule = schedule
        self._shards = shards
        # (3,) log-gains, with their gradients, of the views of this process in the present step.
        self._present: list[Tensor] = []
        self._images = ExposedImages()

    @property
    def ev(self) -> Tensor:
        """(V, 3) on the CPU: the exposures in EV, relative to their mean; no rows if not learnt."""
        rows = self.log_gains if self.active else self.log_gains[:0]
        return GAMMA / math.log(2.0) * rows.cpu()

    def begin_step(self) -> None:
        """Forget the gradients of the last attempt."""
        self._present = []

    def begin_view(self, background: Tensor, index: int) -> Tensor:
        """The colour (3,) over which the training view ``index`` is rendered.

        Args:
            background: (3,) colour in 0..1 behind the photo.
        """
        if not self.active:
            return background
        log_gains = self.log_gains[index].clone().requires_grad_()
        self._present.append(log_gains)
        if self._black:
            return background
        with torch.enable_grad():
            return background * (-log_gains).exp()

    def exposed(self, image: Tensor, photo: LoadedImage, index: int) -> Tensor:
        """The image (H, W, 3) of the view of `begin_view` as its camera exposes it."""
        if not self.active:
            return image
        return self._images.of(image, self._present[-1], photo, index)

    def after_step(self, step: int, indices: Sequence[int]) -> None:
        """Update the gains of the photos of a step.

        Args:
            indices: of the training views of the batch.
        """
        if not self.active:
            return
        size = self._shards.size
        own = self.log_gains.new_zeros(-(-len(indices) // size), 3)
        for row, log_gains in zip(own, self._present, strict=False):
            assert log_gains.grad is not None
            row += log_gains.grad
        table = self._shards.table(own.flatten()).view(size, -1, 3)
        rate = _RATE * (_LAST_RATE / _RATE) ** (step / self._schedule.iterations)
        for position, i in enumerate(indices):  # in each round, process r has view r
            self._update(i, table[position % size, position // size], rate)
        self.log_gains -= self.log_gains.mean(0)

    def _update(self, i: int, gradient: Tensor, rate: float) -> None:
        gain, (b1, b2) = self.log_gains[i], _BETAS
        gradient = gradient + _PRIOR * gain / (_SMALL**2 + gain.square()).sqrt()
        self._updates[i] += 1
        n = int(self._updates[i])
        mean = self._mean[i].lerp_(gradient, 1.0 - b1) / (1.0 - b1**n)
        square = self._square[i].lerp_(gradient.square(), 1.0 - b2) / (1.0 - b2**n)
        gain -= rate * mean / (square.sqrt() + _EPSILON)

    def state_tensors(self) -> dict[str, Tensor]:
        """The state on which the next steps depend; empty if the setting is "off"."""
        if self._setting == "off":
            return {}
        return {
            "active": torch.tensor(self.active),
            "start": self.start,
            "log_gains": self.log_gains,
            "mean": self._mean,
            "square": self._square,
            "updates": self._updates,
        }

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Copy a state of `state_tensors`."""
        if self._setting == "off":
            return
        self.active = bool(tensors["active"])
        self.start.copy_(tensors["start"])
        self.log_gains.copy_(tensors["log_gains"])
        self._mean.copy_(tensors["mean"])
        self._square.copy_(tensors["square"])
        self._updates.copy_(tensors["updates"])


def _reason(start: ExposureStart, active: bool) -> str:
    if start.spread is None:
        found = "not known, because there are neither points nor EXIF data"
    else:
        found = f"photos differ by {start.spread:.2f} EV (standard deviation, from {start.source})"
    what = "one gain for each photo and channel is learnt" if active else "no gains are learnt"
    return f"exposure: {found}; {what}"
