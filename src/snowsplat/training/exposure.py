"""`Exposure`: a gain for each photo and channel, which the training learns together with the scene.

A camera that chooses exposure and white balance for each photo makes the same surface brighter in
one photo than in another. The scene has one colour for it. So the colours c of the splats are
multiplied by the gains of the photo, before they are blended and the image is compared:

    c'_i = c_i exp(g_v),      ∂L/∂g_v = Σ_i ∂L/∂c'_i c'_i      for each channel.

Blending is linear in the colours, so this multiplies the image, without the background, which is
not a part of the photo.

The gains follow Adam, with the prior ε √(τ² + g²), which is quadratic for small gains and linear
for large ones. After each update, the mean of g over the photos is subtracted. Otherwise scene and
gains could change together, and the colours of the scene would be arbitrary; so they are neutral.

Where a photo is overexposed, it only says that the image is at least as bright.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset
from snowsplat.data.decode import LoadedImage
from snowsplat.data.image_loader import Photos
from snowsplat.ops.splats import COLORS, Splats2D
from snowsplat.training.exposure_start import GAMMA, ExposureStart, exposure_start
from snowsplat.training.shards import Shards
from snowsplat.training.step_schedule import Schedule

#: With a smaller spread, in EV, the gains are not learnt.
LEAST_SPREAD = 0.05
#: The learning rate of the log-gains at the first and at the last step.
_RATE, _LAST_RATE = 5e-3, 5e-4
_BETAS = 0.9, 0.99
_EPSILON = 1e-12
#: ε and τ of the prior.
_PRIOR, _SMALL = 1e-3, 0.3
_CHANNELS = slice(COLORS, COLORS + 3)
#: 8-bit values from this one on are overexposed.
_OVEREXPOSED = 254


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
    ) -> None:
        """
        Args:
            setting: "auto", "on" or "off", see ``TrainConfig.exposure``.
            resumed: whether `load_state` follows, so that the photos need not be compared.

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
        self._schedule = schedule
        self._shards = shards
        self._gain = torch.ones(3)  # of the present view
        self._gradients: list[Tensor] = []  # of the views of this process in the present step
        self._overexposed: dict[tuple[int, int], bool] = {}  # by view and height

    @property
    def ev(self) -> Tensor:
        """(V, 3) on the CPU: the exposures in EV, relative to their mean; no rows if not learnt."""
        rows = self.log_gains if self.active else self.log_gains[:0]
        return GAMMA / math.log(2.0) * rows.cpu()

    def begin_step(self) -> None:
        """Forget the gradients of the last attempt."""
        self._gradients = []

    def apply(self, splats: Splats2D, index: int) -> None:
        """Multiply the colours of splats, in place, by the gains of the training view ``index``."""
        if self.active:
            self._gain = self.log_gains[index].exp()
            splats.packed[:, _CHANNELS] *= self._gain

    def clipped(self, image: Tensor, photo: LoadedImage, index: int) -> Tensor:
        """The image (H, W, 3), at most 1 where the photo of view ``index`` is overexposed."""
        if not self.active:
            return image
        key = index, image.shape[0]
        if key not in self._overexposed:  # most photos have no such pixels, which saves time
            self._overexposed[key] = bool((photo.rgb >= _OVEREXPOSED).any())
        if not self._overexposed[key]:
            return image
        return torch.where((photo.rgb >= _OVEREXPOSED) & (image.detach() > 1.0), 1.0, image)

    def after_backward(self, splats: Splats2D) -> None:
        """Store the gradient of the gains; change that of the splats to that without the gains."""
        if not self.active:
            return
        colors, packed_grad = splats.packed.detach()[:, _CHANNELS], splats.packed.grad
        assert packed_grad is not None
        grad = packed_grad[:, _CHANNELS]
        # Empty rows may contain any values, but have no gradient.
        products = torch.where(grad == 0.0, 0.0, colors * grad)
        self._gradients.append(products.sum(0, dtype=torch.float64).to(torch.float32))
        grad *= self._gain

    def after_step(self, step: int, indices: Sequence[int]) -> None:
        """Update the gains of the photos of a step.

        Args:
            indices: of the training views of the batch.
        """
        if not self.active:
            return
        size = self._shards.size
        own = self.log_gains.new_zeros(-(-len(indices) // size), 3)
        for row, gradient in zip(own, self._gradients, strict=False):
            row += gradient
        table = self._shards.table(own.flatten()).view(size, -1, 3)
        rate = _RATE * (_LAST_RATE / _RATE) ** (step / self._schedule.iterations)
        for position, i in enumerate(indices):  # in each round, process r has view r
            gradient = len(indices) * table[position % size, position // size]
            self._update(i, gradient, rate)
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
